"""What the model knows at one step, and who the nodes are."""

import equinox as eqx
from jaxtyping import Array, Bool, Float

from contactgraph.model.belief import ContactBelief


class Nodes(eqx.Module):
    """What does not change over a run, padded to a capacity of ``N`` nodes."""

    actuated: Bool[Array, " N"]
    mask: Bool[Array, " N"]
    """False for padding, which takes part in nothing."""
    candidate: Bool[Array, " E"]
    """Whether an edge may ever be active; edges in `pair_indices`' order."""


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
