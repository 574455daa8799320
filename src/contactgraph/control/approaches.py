"""Approaches: an actuated body goes round another and pushes it, as a policy of a few numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_STAND_OFF, _ROUND = 1.5, 1.9
"""Contact distances from the body: where a push begins, and on the way round."""
_CLEAR = 1.2
"""Contact distances within which it first goes straight away, as its shape may be hooked in."""
_AHEAD = 0.7
"""rad; by how much the hand aims ahead on the way round."""
_BEHIND = 0.87
"""Cosine of the angle to the line of the push within which it goes straight behind the body."""
_BESIDE = 0.5
"""Contact distances beside the line of a push at which the push has slid off."""
_GAIN = 0.25
"""Part of a distance that is to be covered in a step."""
_TINY = 1e-9


class Approach(eqx.Module):
    """One approach, or a batch of ``S``: from where, how far beside, how fast, how far."""

    hand: Int[Array, "*S"]
    """The actuated node that pushes."""
    body: Int[Array, "*S"]
    """The node that is pushed."""
    direction: Float[Array, "*S D"]
    """Of the push, in any length."""
    aside: Float[Array, "*S D"]
    """Contact distances from the body's centre to the line of the push; its part along the
    direction is left out."""
    speed: Float[Array, "*S"]
    """m/s of the push, at most."""
    travel: Float[Array, "*S"]
    """m by which the body is pushed; 0: the hand stays."""
    approach_speed: Float[Array, "*S"]
    """m/s on the way behind the body, at most."""

    def at(self, index: Int[Array, " S"]) -> "Approach":
        """Some of a batch."""
        return jax.tree.map(lambda leaf: leaf[index], self)

    def velocity(
        self,
        position: Float[Array, "N D"],
        begin: Float[Array, "N D"],
        contact_distance: Float[Array, ""],
        dt: float,
    ) -> Float[Array, " D"]:
        """The wanted velocity [m/s] of the hand in a step; ``begin``: where the plan started."""
        along = _unit(self.direction)
        aside = contact_distance * (self.aside - _dot(self.aside, along) * along)
        at = position[self.body]
        offset = position[self.hand] - at
        missing = self.travel - _dot(at - begin[self.body], along)
        back = -_dot(offset, along)
        beside = offset + back * along - aside
        speed = jnp.clip(_GAIN * missing / dt, 0.0, self.speed)
        pushing = speed * along - _GAIN * beside / dt

        # Where both ways round are as long, it passes on the side of the last axis.
        outward = _unit(offset.at[-1].add(1e-3 * contact_distance))
        turned = jnp.cos(_AHEAD) * outward - jnp.sin(_AHEAD) * _unit(
            along - _dot(along, outward) * outward
        )
        near = _length(offset) < _CLEAR * contact_distance
        turned = jnp.where(near, outward, turned)
        behind = _dot(outward, along) < -_BEHIND
        wait = aside - _STAND_OFF * contact_distance * along
        aim = jnp.where(behind, wait, _ROUND * contact_distance * turned)
        going = 2.0 * _GAIN * (aim - offset) / dt
        going = going * jnp.minimum(1.0, self.approach_speed / _length(going))
        ready = (back > 0.0) & (_length(beside) < _BESIDE * contact_distance)
        return jnp.where(missing > 0.0, jnp.where(ready, pushing, going), 0.0)


class Draws(eqx.Module):
    """Standard normal numbers, from which approaches are made; ``S`` of each."""

    direction: Float[np.ndarray, "S D"]
    aside: Float[np.ndarray, "S D"]
    speed: Float[np.ndarray, " S"]
    travel: Float[np.ndarray, " S"]
    approach_speed: Float[np.ndarray, " S"]

    @classmethod
    def of(cls, rng: np.random.Generator, count: int, dimension: int) -> "Draws":
        """``count`` new ones."""
        vectors = rng.standard_normal((2, count, dimension))
        return cls(*vectors, *rng.standard_normal((3, count)))


def spread_approaches(
    draws: Draws,
    hand: Int[Array, " S"],
    body: Int[Array, " S"],
    missing: Float[Array, "S D"],
    top_speed: float,
    up: Float[Array, " D"],
) -> Approach:
    """Approaches of all sides, every second one near the line to the goal; the first one stays.

    Speeds are spread evenly by their logarithm, from a twelfth of ``top_speed`` [m/s] on; on the
    way from a third on.

    ``missing``: [m] from each body to its goal; ``up``: a unit vector along which none pushes, or
    zeros.
    """
    distance = _length(missing)
    wide = jnp.where(jnp.arange(len(hand)) % 2 == 0, 1.0, 0.25)[:, None]
    direction = missing / distance[:, None] + wide * draws.direction
    travel = distance * jnp.exp(0.3 * draws.travel)
    return Approach(
        hand=hand,
        body=body,
        direction=_unit(_level(direction, up)),
        aside=0.3 * jnp.asarray(draws.aside),
        speed=top_speed * jnp.exp(-2.5 * jax.scipy.stats.norm.cdf(draws.speed)),
        travel=travel.at[0].set(0.0),
        approach_speed=top_speed * jnp.exp(-jax.scipy.stats.norm.cdf(draws.approach_speed)),
    )


def varied_approaches(draws: Draws, approaches: Approach, up: Float[Array, " D"]) -> Approach:
    """As many approaches near the given ones, of which there are fewer, as there are draws."""
    of = approaches.at(jnp.arange(len(draws.speed)) % len(approaches.speed))
    return dataclasses.replace(
        of,
        direction=of.direction + _level(0.15 * jnp.asarray(draws.direction), up),
        aside=of.aside + 0.1 * draws.aside,
        speed=of.speed * jnp.exp(0.2 * draws.speed),
        travel=of.travel * jnp.exp(0.15 * draws.travel),
        approach_speed=of.approach_speed * jnp.exp(0.2 * draws.approach_speed),
    )


def _level(vector: Float[Array, "S D"], up: Float[Array, " D"]) -> Float[Array, "S D"]:
    return vector - _dot(vector, up)[..., None] * up


def _dot(one: Float[Array, "*S D"], other: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    return jnp.sum(one * other, axis=-1)


def _length(vector: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _TINY)


def _unit(vector: Float[Array, "*S D"]) -> Float[Array, "*S D"]:
    return vector / _length(vector)[..., None]
