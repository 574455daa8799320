"""What keeps hinged bodies, and what they hold, on the circle about the hinge."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.model.edges import at_nodes
from contactgraph.model.hinges import Bars

_SMALLEST = 1e-9
_RESTING_SPEED = 0.1
"""Relative speed, m/s, well below which two bodies that hold are at rest against each other."""


class Circling(eqx.Module):
    r"""Springs to the hinges. A spring of rate $\omega^2$ keeps what turns about its end turning.

    A hinged node has one of its own; a free node that a hinged one holds has a part of it.
    """

    rate: Float[Array, " N"]
    """k/m, 1/s^2."""
    centre: Float[Array, "N D"]
    """m; the node's own position where nothing turns it."""
    radius: Float[Array, " N"]
    """m; distance from the centre that is to be kept."""
    keeps: Float[Array, " N"]
    """How far it is kept, in [0, 1]."""

    def kept(self, position: Float[Array, "N D"]) -> Float[Array, "N D"]:
        """What to add to predicted positions [m], so that they are on their circles."""
        arm = position - self.centre
        length = jnp.sqrt(jnp.sum(arm**2, axis=-1) + _SMALLEST)
        return (self.keeps * (self.radius / length - 1.0))[:, None] * arm


def circling(
    anchor: Float[Array, "N D"],
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    hold: Float[Array, " E"],
    ends: Int[Array, "2 E"],
    relative_velocity: Float[Array, "E D"],
) -> Circling:
    """The springs of a step, of nodes that move with `velocity` [m/s] in it.

    `hold` in [0, 1] is how far each edge holds, whose nodes are `ends`, of which the second has the
    `relative_velocity` [m/s] against the first.
    """
    count = position.shape[0]
    bars = Bars(position, anchor)
    turning = jnp.sum(velocity**2, axis=-1) / bars.arm_squared
    # From the hinged end of an edge to its free end.
    passes = bars.hinged[ends[::-1]] & ~bars.hinged[ends]
    weight = jnp.where(passes, hold, 0.0)
    square = jnp.sum(relative_velocity**2, axis=-1)
    rests = weight * _RESTING_SPEED**2 / (square + _RESTING_SPEED**2)
    other = ends[::-1]
    total = at_nodes(weight, ends, count)
    share = jnp.minimum(1.0, 1.0 / jnp.maximum(total, _SMALLEST))
    rate = share * at_nodes(weight * turning[other], ends, count)
    held_centre = at_nodes(weight[..., None] * bars.anchor[other], ends, count)
    held_centre = held_centre / jnp.maximum(total, _SMALLEST)[:, None]
    tied = total > _SMALLEST
    hinged = bars.hinged
    centre = jnp.where(
        hinged[:, None], bars.anchor, jnp.where(tied[:, None], held_centre, position)
    )
    radius = jnp.sqrt(jnp.sum((position - centre) ** 2, axis=-1) + _SMALLEST)
    keeps = share * at_nodes(rests, ends, count)
    return Circling(
        rate=jnp.where(hinged, turning, rate),
        centre=centre,
        radius=radius,
        keeps=jnp.where(hinged, 1.0, keeps),
    )
