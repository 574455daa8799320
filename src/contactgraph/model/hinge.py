"""Bodies on hinges: bars that turn about a fixed point."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.graph import sum_at_nodes

_SMALLEST = 1e-12


class HingedBodies(eqx.Module):
    """Nodes of which some hang on hinges, at one step.

    A hinged node is taken for the middle of a straight bar that begins at its hinge. Bars turn
    rigidly, so the velocity of the node tells that of every point that turns with it.
    """

    position: Float[Array, "N D"]
    """m"""
    hinged: Bool[Array, " N"]
    anchor: Float[Array, "N D"]
    """m; zero where there is no hinge."""
    arm: Float[Array, "N D"]
    """From the hinge to the node, m; of length 1 where there is no hinge."""

    def __init__(self, position: Float[Array, "N D"], anchor: Float[Array, "N D"]):
        """`anchor` is NaN where a node has no hinge."""
        self.position = position
        self.hinged = jnp.isfinite(anchor[:, 0])
        self.anchor = jnp.where(self.hinged[:, None], anchor, 0.0)
        unit = jnp.zeros_like(position).at[:, 0].set(1.0)
        self.arm = jnp.where(self.hinged[:, None], position - self.anchor, unit)

    @property
    def arm_squared(self) -> Float[Array, " N"]:
        """Squared length of the arm, m^2."""
        return jnp.maximum(jnp.sum(self.arm**2, axis=-1), _SMALLEST)

    def closest_point(
        self, node: Int[Array, " E"], point: Float[Array, "E D"]
    ) -> tuple[Float[Array, "E D"], Float[Array, "E D"]]:
        """The bars' points nearest to `point` [m], and the directions in which they may slide.

        A direction is the bar's own (a unit vector) where the nearest point lies inside the bar,
        and zero at its ends and for nodes without a hinge, whose only point is their own.
        """
        arm, squared = self.arm[node], self.arm_squared[node]
        fraction = jnp.sum((point - self.anchor[node]) * arm, axis=-1) / squared
        inside = self.hinged[node] & (fraction > 0.0) & (fraction < 2.0)
        on_bar = self.anchor[node] + jnp.clip(fraction, 0.0, 2.0)[:, None] * arm
        along = arm / jnp.sqrt(squared)[:, None]
        return (
            jnp.where(self.hinged[node][:, None], on_bar, self.position[node]),
            jnp.where(inside[:, None], along, 0.0),
        )

    def contact_jacobian(
        self, node: Int[Array, " E"], point: Float[Array, "E D"]
    ) -> Float[Array, "E D D"]:
        r"""The matrix L that takes a node's velocity to that of the material at `point` [m].

        With arm $r$ and $b$ from the hinge to the point, $L = (r \cdot b\, I - r b^T) / r^2$; the
        identity for nodes without a hinge. Its transpose takes a force at the point to the node,
        and leaves nothing of it along the arm, which the hinge bears.
        """
        arm, reach = self.arm[node], point - self.anchor[node]
        identity = jnp.eye(point.shape[-1], dtype=point.dtype)
        turning = jnp.sum(arm * reach, axis=-1)[:, None, None] * identity
        turning = turning - arm[:, :, None] * reach[:, None, :]
        turning = turning / self.arm_squared[node][:, None, None]
        return jnp.where(self.hinged[node][:, None, None], turning, identity)


_SMALLEST_circling = 1e-9
_RESTING_SPEED = 0.1
"""Relative speed, m/s, well below which two bodies that hold are at rest against each other."""


class HingeConstraint(eqx.Module):
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
        length = jnp.sqrt(jnp.sum(arm**2, axis=-1) + _SMALLEST_circling)
        return (self.keeps * (self.radius / length - 1.0))[:, None] * arm


def hinge_constraint(
    anchor: Float[Array, "N D"],
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    hold: Float[Array, " E"],
    ends: Int[Array, "2 E"],
    relative_velocity: Float[Array, "E D"],
) -> HingeConstraint:
    """The springs of a step, of nodes that move with `velocity` [m/s] in it.

    `hold` in [0, 1] is how far each edge holds, whose nodes are `ends`, of which the second has the
    `relative_velocity` [m/s] against the first.
    """
    count = position.shape[0]
    bars = HingedBodies(position, anchor)
    turning = jnp.sum(velocity**2, axis=-1) / bars.arm_squared
    # From the hinged end of an edge to its free end.
    passes = bars.hinged[ends[::-1]] & ~bars.hinged[ends]
    weight = jnp.where(passes, hold, 0.0)
    square = jnp.sum(relative_velocity**2, axis=-1)
    rests = weight * _RESTING_SPEED**2 / (square + _RESTING_SPEED**2)
    other = ends[::-1]
    total = sum_at_nodes(weight, ends, count)
    share = jnp.minimum(1.0, 1.0 / jnp.maximum(total, _SMALLEST_circling))
    rate = share * sum_at_nodes(weight * turning[other], ends, count)
    held_centre = sum_at_nodes(weight[..., None] * bars.anchor[other], ends, count)
    held_centre = held_centre / jnp.maximum(total, _SMALLEST_circling)[:, None]
    tied = total > _SMALLEST_circling
    hinged = bars.hinged
    centre = jnp.where(
        hinged[:, None], bars.anchor, jnp.where(tied[:, None], held_centre, position)
    )
    radius = jnp.sqrt(jnp.sum((position - centre) ** 2, axis=-1) + _SMALLEST_circling)
    keeps = share * sum_at_nodes(rests, ends, count)
    return HingeConstraint(
        rate=jnp.where(hinged, turning, rate),
        centre=centre,
        radius=radius,
        keeps=jnp.where(hinged, 1.0, keeps),
    )
