"""Costs of distances: bodies that a plan is to touch, or not to touch."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.data.errors import InvalidInputError

_TINY = 1e-9
"""m; where two bodies coincide, no direction leads away."""


class DistanceCost(eqx.Module):
    """``sum over steps and pairs of weight * max(0, side * (distance - |x_a - x_b|))^2``.

    ``side`` is 1 where a pair is to stay farther apart than ``distance`` (`avoid`), and -1 where it
    is to come nearer (`touch`). The distance is the least one within the ``dt`` before a state, on
    the straight lines along which both bodies came.

    The first body of a pair is moved away from, or to, the second one, which is taken to move as it
    is predicted: its own share in the slope is left out. What is planned is still judged by the
    whole cost. Other arrays of the same shapes do not recompile.
    """

    pairs: Int[Array, "P 2"]
    distance: Float[Array, " P"]
    """m, from centre to centre."""
    weight: Float[Array, " P"] | Float[Array, "H+1 P"]
    """1/m^2, the same for all steps or one a step; 0 leaves a pair out."""
    side: Float[Array, " P"]
    dimension: int = eqx.field(static=True)
    """D; coordinates of a position, of which turns are none."""
    dt: float = eqx.field(static=True)
    """s; length of a step. 0: only the states count, not what was between them."""

    def by_step(self, states: Float[Array, "H+1 N 2 G"]) -> Float[Array, " H+1"]:
        """The cost of each step."""
        missing, _, _ = self._missing(states)
        return jnp.sum(self.weight * missing**2, axis=-1)

    def expanded(
        self, states: Float[Array, "H+1 N 2 G"], node_ids: Int[Array, " M"]
    ) -> tuple[Float[Array, "H+1 m m"], Float[Array, "H+1 m"]]:
        """``Q`` and ``q`` of ``x^T Q x + 2 q^T x`` near these states, for x as `block_state` of
        the M nodes; Gauss-Newton, so ``Q`` is positive semi-definite."""
        missing, direction, when = self._missing(states)
        slope = jnp.stack([direction, when[..., None] * direction], axis=2)
        slope *= -self.side[:, None, None]
        active = (missing > 0.0) & (self.weight > 0.0)
        slope = jnp.where(active[..., None, None], slope, 0.0)
        is_first = self.pairs[:, 0, None] == node_ids
        J = jnp.where(is_first[:, None, :, None], slope[:, :, :, None, :], 0.0)
        more = states.shape[-1] - self.dimension
        J = jnp.pad(J, [(0, 0)] * 4 + [(0, more)]).reshape(*missing.shape, -1)
        x = jnp.moveaxis(states[:, node_ids], 2, 1).reshape(len(states), -1)
        weighted = jnp.broadcast_to(self.weight, missing.shape)[..., None] * J
        rest = missing - jnp.einsum("tpi,ti->tp", J, x)
        return jnp.einsum("tpi,tpj->tij", weighted, J), jnp.einsum("tpi,tp->ti", weighted, rest)

    def _missing(self, states: Array) -> tuple[Array, Array, Array]:
        """[H+1, P] m that a pair is too near or too far; the direction [H+1, P, D] from the second
        to the first, where they were nearest; and when, s from the state's time on, at most 0."""
        moving = states[..., : self.dimension]
        apart = moving[:, self.pairs[:, 0]] - moving[:, self.pairs[:, 1]]
        position, velocity = apart[:, :, 0], apart[:, :, 1]
        speed = jnp.sum(velocity**2, axis=-1)
        when = -jnp.sum(position * velocity, axis=-1) / jnp.maximum(speed, _TINY)
        when = jax.lax.stop_gradient(jnp.clip(when, -self.dt, 0.0))
        closest = position + when[..., None] * velocity
        length = jnp.sqrt(jnp.sum(closest**2, axis=-1) + _TINY**2)
        missing = jax.nn.relu(self.side * (self.distance - length))
        return missing, closest / length[..., None], when

    def joined(self, other: "DistanceCost") -> "DistanceCost":
        """Both costs; `InvalidInputError` where their dimensions or steps differ."""
        if (self.dimension, self.dt) != (other.dimension, other.dt):
            raise InvalidInputError(
                f"costs of distances must have the same dimension and dt, found {self.dimension}, "
                f"{self.dt:g} and {other.dimension}, {other.dt:g}"
            )
        both, count = (self, other), (len(self.pairs), len(other.pairs))
        steps = np.broadcast_shapes(*(each.weight.shape[:-1] for each in both))
        weights = [
            jnp.broadcast_to(each.weight, (*steps, pairs))
            for each, pairs in zip(both, count, strict=True)
        ]
        return DistanceCost(
            pairs=jnp.concatenate([self.pairs, other.pairs]),
            distance=jnp.concatenate([self.distance, other.distance]),
            weight=jnp.concatenate(weights, axis=-1),
            side=jnp.concatenate([self.side, other.side]),
            dimension=self.dimension,
            dt=self.dt,
        )


def avoid(
    pairs: Sequence[tuple[int, int]] | np.ndarray,
    distance: float | Sequence[float] | np.ndarray,
    weight: float | np.ndarray,
    dt: float = 0.0,
    dimension: int = 2,
) -> DistanceCost:
    """A cost of coming nearer than ``distance`` [m, centre to centre] to what must not be touched.

    ``pairs``: (moved node, other node); the moved one must be a node with a cost. ``weight``
    [1/m^2]: one number, [P], or [H+1, P]. ``dt`` [s]: the length of a step, so that nothing is
    passed through between two states. Raises `InvalidInputError` where a number is out of range.
    """
    nodes = np.asarray(pairs, dtype=np.int32).reshape(-1, 2)
    if np.any(nodes < 0) or np.any(nodes[:, 0] == nodes[:, 1]):
        raise InvalidInputError(f"pairs must name two different nodes each, found {pairs}")
    gaps = np.broadcast_to(np.asarray(distance, dtype=np.float64), len(nodes))
    weights = np.asarray(weight, dtype=np.float64)
    weights = np.broadcast_to(weights, (*weights.shape[:-1], len(nodes)))
    for name, values in (("distance", gaps), ("weight", weights), ("dt", np.asarray(dt))):
        if not (np.all(np.isfinite(values)) and np.all(values >= 0.0)):
            raise InvalidInputError(f"{name} must be finite and not negative, found {values}")
    return DistanceCost(
        pairs=jnp.asarray(nodes),
        distance=jnp.asarray(gaps),
        weight=jnp.asarray(weights),
        side=jnp.ones(len(nodes)),
        dimension=dimension,
        dt=float(dt),
    )


def touch(
    pairs: Sequence[tuple[int, int]] | np.ndarray,
    distance: float | Sequence[float] | np.ndarray,
    weight: float | np.ndarray,
    dt: float = 0.0,
    dimension: int = 2,
) -> DistanceCost:
    """A cost of staying farther than ``distance`` [m, centre to centre] from what is to be touched;
    arguments as of `avoid`."""
    away = avoid(pairs, distance, weight, dt, dimension)
    return replace(away, side=-away.side)
