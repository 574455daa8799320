"""How far a model's edges reach: what tells who can matter to whom."""

import math
from dataclasses import dataclass

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.coupled_head import CoupledHead
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.reach import Reach


@dataclass(frozen=True)
class Locality:
    """A model in which nodes that stay farther apart than ``far`` do not know of each other.

    And in which a node that touches nothing is slowed down by nothing but the ground, and driven
    by nothing but a control that acts on it.
    """

    far: float
    """m, from centre to centre, or to a bar's middle line."""
    dt: float
    """s, of a step."""


def locality(model: object) -> Locality | None:
    """None where edges have no end, or where a node may move of itself (free matrices, the paper's
    head with its free equilibria), or where nobody knows: any object can be planned with."""
    if not isinstance(model, ContactDynamics) or not isinstance(model.reach, Reach):
        return None
    dynamics = model.local_dynamics
    if not isinstance(dynamics, SpringMassDamperDynamics):
        return None
    if not isinstance(dynamics.head, CoupledHead) or not math.isfinite(model.reach.far):
        return None
    return Locality(model.reach.far, model.dt)
