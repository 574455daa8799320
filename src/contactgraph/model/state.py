"""What the model knows at one step, and who the nodes are."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.model.belief import ContactBelief


class Nodes(eqx.Module):
    """What does not change over a run, padded to a capacity of ``N`` nodes."""

    actuated: Bool[Array, " N"]
    mask: Bool[Array, " N"]
    """False for padding, which takes part in nothing."""
    candidate: Bool[Array, " E"]
    """Whether an edge may ever be active; edges in `pair_indices`' order."""
    anchor: Float[Array, "N D"] | None = None
    """m; where a node is hinged, NaN where it is not. None: nobody is."""

    @property
    def hinged(self) -> Bool[Array, " N"]:
        """Whether a node hangs on a hinge."""
        if self.anchor is None:
            return jnp.zeros_like(self.mask)
        return jnp.isfinite(self.anchor[:, 0])


class ModelState(eqx.Module):
    """State of the scene and what is believed about its contacts."""

    position: Float[Array, "N D"]
    """m"""
    velocity: Float[Array, "N D"]
    """m/s"""
    belief: ContactBelief
    """About the step that led here; the next step's belief is predicted from it."""
    push: Float[Array, "N D"] | None = None
    """m; how far the coming step's control alone moves each node. Whether bodies touch within the
    step depends on it. None: not known."""
