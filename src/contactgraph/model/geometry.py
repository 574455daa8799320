"""Distances and relative motion along the edges."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_SMALLEST = 1e-12
_RESTING_SPEED = 0.01
"""Relative speed, m/s, well below which nothing counts as an approach."""


class Geometry(eqx.Module):
    """How the two nodes of every edge lie and move relative to each other, seen from the first."""

    first: Int[Array, " E"]
    second: Int[Array, " E"]
    displacement: Float[Array, "E D"]
    """From the first to the second node, m."""
    relative_velocity: Float[Array, "E D"]
    """Of the second node against the first, m/s."""
    distance: Float[Array, " E"]
    """m"""
    coming_distance: Float[Array, " E"]
    """m; after one step without forces."""
    direction: Float[Array, "E D"]
    """Unit vector from the first to the second node."""

    share_after_touch: Float[Array, " E"]
    """Share of the coming step, in [0, 1], that follows the moment at which the two nodes, if
    nothing hindered them, would come as near as bodies touch. 0 where they do not meet."""

    @property
    def nearest(self) -> Float[Array, " E"]:
        """The smaller of the distances now and one step ahead, m."""
        return jnp.minimum(self.distance, self.coming_distance)


def geometry(
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    pairs: Int[Array, "E 2"],
    dt: float,
    touch_distance: Float[Array, ""] | float,
    push: Float[Array, "N D"] | None = None,
) -> Geometry:
    """The geometry of the edges `pairs` at one step of `dt` [s]; finite where nodes coincide.

    Bodies touch `touch_distance` [m] apart, centre to centre. `push` [m] is how far the
    step's control alone moves the nodes, where it is known; what is coming depends on it.
    """
    first, second = pairs[:, 0], pairs[:, 1]
    displacement = position[second] - position[first]
    relative_velocity = velocity[second] - velocity[first]
    distance = _norm(displacement)
    coming = relative_velocity
    if push is not None:
        coming = coming + (push[second] - push[first]) / dt
    return Geometry(
        first=first,
        second=second,
        displacement=displacement,
        relative_velocity=relative_velocity,
        distance=distance,
        coming_distance=_norm(displacement + dt * coming),
        direction=displacement / distance[:, None],
        share_after_touch=_share_after_touch(displacement, coming, dt, touch_distance),
    )


def _share_after_touch(
    displacement: Float[Array, "E D"],
    relative_velocity: Float[Array, "E D"],
    dt: float,
    touch_distance: Float[Array, ""] | float,
) -> Float[Array, " E"]:
    """From the earlier root of |r + w t| = touch distance, where the two approach each other."""
    square = jnp.sum(relative_velocity**2, axis=-1)
    closing = -jnp.sum(displacement * relative_velocity, axis=-1)
    gap = jnp.sum(displacement**2, axis=-1) - touch_distance**2
    discriminant = closing**2 - square * gap
    meets = (discriminant > 0) & (closing > 0)
    root = jnp.sqrt(jnp.where(meets, discriminant, 1.0))
    time = (closing - root) / jnp.maximum(square, _SMALLEST)
    share = jnp.where(meets, jnp.clip(1.0 - time / dt, 0.0, 1.0), 0.0)
    # Bodies that hold together have relative velocities of rounding size, and no impact.
    return share * square / (square + _RESTING_SPEED**2)


def _norm(vector: Float[Array, "E D"]) -> Float[Array, " E"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _SMALLEST)
