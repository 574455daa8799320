"""Where a search for a plan has been: what tells who could have mattered to it.

A rollout is given up at the step up to which it has cost more than the best one: whatever comes
after, it is rejected, so who stands in the way there does not matter.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.rollout import Rollout
from contactgraph.model import Nodes


class SweptBounds(eqx.Module):
    """Boxes around all the places where a rollout had a node in a step: one each of ``R`` rollouts.

    A step's places are those on the way that `contactgraph.model.collision` looks at: from where
    the node is to where it would get in the step if nothing hindered it; and where it gets. Of a
    body on a hinge they are those of the whole bar.
    """

    lower: Float[Array, "R H N D"]
    """m"""
    upper: Float[Array, "R H N D"]
    """m"""

    @classmethod
    def nowhere(cls, rollouts: int, horizon: int, like: Float[Array, "N D"]) -> "SweptBounds":
        """Boxes that hold nothing yet."""
        nothing = jnp.full((rollouts, horizon, *like.shape), jnp.inf, like.dtype)
        return cls(nothing, -nothing)

    def with_rollout(
        self,
        index: Int[Array, ""],
        rollout: Rollout,
        counts: Bool[Array, " H"],
        nodes: Nodes,
        dt: float,
    ) -> "SweptBounds":
        """With the places of the rollout of a number, in those steps of ``dt`` [s] that count."""
        position = rollout.position[:-1]
        # A parabola lies within its ends and where its tangents meet.
        middle = position + 0.5 * dt * rollout.velocity[:-1]
        onward = position + dt * rollout.velocity[:-1] + rollout.control_displacement
        lower, upper = _boxes([position, middle, onward, rollout.position[1:]], nodes)
        counts = counts[:, None, None]
        lower, upper = jnp.where(counts, lower, jnp.inf), jnp.where(counts, upper, -jnp.inf)
        return SweptBounds(
            self.lower.at[index].set(lower.astype(self.lower.dtype)),
            self.upper.at[index].set(upper.astype(self.upper.dtype)),
        )

    def also_at(self, places: list[Float[Array, "N D"]], nodes: Nodes) -> "SweptBounds":
        """With these places [m] in all boxes."""
        lower, upper = _boxes(places, nodes)
        return SweptBounds(jnp.minimum(self.lower, lower), jnp.maximum(self.upper, upper))


def _boxes(
    places: list[Float[Array, "*H N D"]], nodes: Nodes
) -> tuple[Float[Array, "*H N D"], Float[Array, "*H N D"]]:
    """What is not finite is no place."""
    if nodes.anchor is not None:
        anchor, hinged = jnp.nan_to_num(nodes.anchor), nodes.hinged[:, None]
        places = [
            *[jnp.where(hinged, 2.0 * place - anchor, place) for place in places],
            jnp.where(hinged, anchor, places[0]),
        ]
    stacked = jnp.stack(places)
    known = jnp.isfinite(stacked)
    lower = jnp.min(jnp.where(known, stacked, jnp.inf), axis=0)
    return lower, jnp.max(jnp.where(known, stacked, -jnp.inf), axis=0)
