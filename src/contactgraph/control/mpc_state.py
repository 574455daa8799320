"""What model predictive control carries from tick to tick."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.plan import Plan
from contactgraph.control.swept import Swept
from contactgraph.model import ContactBelief, Nodes


class Seen(eqx.Module):
    """What a tick saw, believed and answered: the next one's view of the step between them."""

    position: Float[Array, "N D"]
    """m; NaN before the first tick."""
    velocity: Float[Array, "N D"]
    """m/s"""
    belief: ContactBelief
    """About the step that led there, corrected by all that was observed."""
    told: Float[Array, " E"]
    """See `MotionEvidence`."""
    control: Float[Array, " U"]
    """N, of the plan that was handed over."""


class Part(eqx.Module):
    """A scene of which only some nodes are in play, padded to a room for n."""

    nodes: Nodes
    """[n] Those in play."""
    cost: QuadraticCost
    """[2nD] About them."""
    always: np.ndarray
    """[n] bool: who of them is in play wherever things are."""
    left_out: np.ndarray
    """[r] Nodes of the scene that are not in play."""
    of: tuple[Nodes, QuadraticCost]
    """The whole scene that this is a part of."""


class MPCState(eqx.Module):
    """What is carried from tick to tick. `dataclasses.replace` it to change cost or nodes.

    These two are about the whole scene, all else is about the ``n`` nodes in play: see `who`.
    """

    nodes: Nodes
    cost: QuadraticCost
    belief: ContactBelief
    """About the step that leads to the next observation, not yet corrected by its contacts."""
    plan: Plan
    """The running plan, as of the last observation."""
    unplanned: Int[Array, ""]
    """Ticks since a plan was made."""
    seen: Seen
    """By the last tick."""
    fresh: Bool[Array, ""]
    """True until the first tick: the plan starts at the coming observation, not before it."""
    swept: Swept | None = None
    """Where the last search for a plan led. None: nobody asks."""
    part: Part | None = None
    """None: everyone is in play."""
    last_seen: tuple[np.ndarray, np.ndarray] | None = None
    """Position m and velocity m/s of all nodes, each [N, D], where only a part is in play."""

    @property
    def who(self) -> np.ndarray:
        """[n] The scene's nodes in play, in their order; -1 for padding."""
        return np.asarray(self.plan.who)
