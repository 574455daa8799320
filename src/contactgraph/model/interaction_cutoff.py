"""The guarantee of a model that far nodes do not affect each other."""

import dataclasses

from contactgraph.bodies.message_passing import EdgeNetwork
from contactgraph.dynamics.contact_law import ContactLaw
from contactgraph.inference.prior import SmoothCutoff
from contactgraph.model.contact_dynamics import ContactDynamics


@dataclasses.dataclass(frozen=True)
class InteractionCutoff:
    """Guarantee of a model: nodes farther apart than ``distance`` do not affect each other.

    A node that touches nothing is decelerated only by the ground, and driven only by a control that
    acts on it.
    """

    distance: float
    """m, from centre to centre, or to a bar's middle line."""
    dt: float
    """Length of a step, s."""


def interaction_cutoff(model: object) -> InteractionCutoff | None:
    """The model's cutoff as a guarantee on predictions; None where it gives none.

    There is none without a cutoff of edges, with rounds of messages (an edge then depends on its
    nodes' other neighbours), where nodes may move by themselves (free matrices, the paper's head
    with its free equilibria), or where pins join far ones.
    """
    if not isinstance(model, ContactDynamics) or not isinstance(model.cutoff, SmoothCutoff):
        return None
    networks = [*model.local_dynamics.message_passing.networks, *model.inference.networks]
    if not all(isinstance(network, EdgeNetwork) for network in networks):
        return None
    head = getattr(model.local_dynamics, "head", None)
    if not isinstance(head, ContactLaw) or head.turn_length is not None:  # pins join far bodies
        return None
    return InteractionCutoff(model.cutoff.outer, model.dt)
