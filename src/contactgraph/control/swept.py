"""Where a search for a plan has been: what tells who could have mattered to it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.rollout import Rollout
from contactgraph.model import Nodes


class Swept(eqx.Module):
    """Boxes, one a step and node, around all the places where any rollout had the node then.

    A step's places are those on the way that `contactgraph.model.geometry` looks at: from where
    the node is to where it would get in the step if nothing hindered it; and where it gets. Of a
    body on a hinge they are those of the whole bar.
    """

    lower: Float[Array, "H N D"]
    """m"""
    upper: Float[Array, "H N D"]
    """m"""

    @classmethod
    def nowhere(cls, horizon: int, like: Float[Array, "N D"]) -> "Swept":
        """Boxes that hold nothing yet."""
        nothing = jnp.full((horizon, *like.shape), jnp.inf, like.dtype)
        return cls(nothing, -nothing)

    def and_by(self, rollout: Rollout, nodes: Nodes, dt: float) -> "Swept":
        """With the places of one more rollout, of steps of ``dt`` [s]."""
        position = rollout.position[:-1]
        drifted = position + dt * rollout.velocity[:-1]
        # A parabola lies within its ends and where its tangents meet.
        middle = position + 0.5 * dt * rollout.velocity[:-1]
        return self.and_at([position, middle, drifted + rollout.push, rollout.position[1:]], nodes)

    def and_at(self, places: list[Float[Array, "*H N D"]], nodes: Nodes) -> "Swept":
        """With these places [m] as well; what is not finite is no place."""
        if nodes.anchor is not None:
            anchor, hinged = jnp.nan_to_num(nodes.anchor), nodes.hinged[:, None]
            places = [
                *[jnp.where(hinged, 2.0 * place - anchor, place) for place in places],
                jnp.where(hinged, anchor, places[0]),
            ]
        lower, upper = self.lower, self.upper
        for place in places:
            place = place.astype(lower.dtype)
            known = jnp.isfinite(place)
            lower = jnp.minimum(lower, jnp.where(known, place, jnp.inf))
            upper = jnp.maximum(upper, jnp.where(known, place, -jnp.inf))
        return Swept(lower, upper)
