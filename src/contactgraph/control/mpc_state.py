"""What model predictive control carries from tick to tick."""

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Motion
from contactgraph.control.plan import Plan
from contactgraph.control.swept_bounds import SweptBounds
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


class Memory(eqx.Module):
    """What one compiled tick leaves to the next, about the ``n`` nodes in play."""

    belief: ContactBelief
    """About the step that leads to the next observation, not yet corrected by its contacts."""
    plan: Plan
    """The running plan, as of the last observation."""
    steps_since_plan: Int[Array, ""]
    """Ticks since a plan was made."""
    seen: Seen
    """By the last tick."""
    fresh: Bool[Array, ""]
    """True until the first tick: the plan starts at the coming observation, not before it."""
    swept: SweptBounds | None
    """Where the last search for a plan led. None: nobody asks."""


@dataclass(frozen=True, eq=False)
class Part:
    """The nodes of a scene that are in play, padded to a room for n."""

    who: np.ndarray
    """[n] Their numbers in the scene, in their order; -1 for padding."""
    nodes: Nodes
    """[n]"""
    cost: QuadraticCost
    """[2nD] About them."""
    always: np.ndarray
    """[n] bool: who of them is in play wherever things are."""
    left_out: np.ndarray
    """[r] Nodes of the scene that are not in play."""
    of: tuple[Nodes, QuadraticCost]
    """The whole scene that this is a part of."""


@dataclass(frozen=True, eq=False)
class MPCState:
    """What is carried from tick to tick. `dataclasses.replace` it to change cost or nodes."""

    nodes: Nodes
    """Of the whole scene."""
    cost: QuadraticCost
    """About the whole scene."""
    part: Part
    """Who of it is in play."""
    memory: Memory
    """About those in play."""
    last_seen: Motion
    """Of all nodes: the last observation that was finite."""

    @property
    def who(self) -> np.ndarray:
        """[n] The scene's nodes in play, in their order; -1 for padding."""
        return self.part.who

    @property
    def plan(self) -> Plan:
        """The running plan, as of the last observation."""
        return self.memory.plan

    @property
    def belief(self) -> ContactBelief:
        """About the step that leads to the next observation, not yet corrected by its contacts."""
        return self.memory.belief

    @property
    def seen(self) -> Seen:
        """By the last tick."""
        return self.memory.seen
