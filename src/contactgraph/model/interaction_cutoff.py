"""The guarantee of a model that far nodes do not affect each other."""

import dataclasses

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.edge_inference import AllEdges, PriorEdges
from contactgraph.model.edges import SmoothCutoff
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.message_passing import EdgeNetwork


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
    dynamics, inference = model.local_dynamics, model.inference
    if not isinstance(dynamics, SpringMassDamperDynamics):
        return None
    networks = list(dynamics.message_passing.types)
    if not isinstance(inference, AllEdges | PriorEdges):
        networks.append(inference.message_passing)
    if not all(isinstance(network, EdgeNetwork) for network in networks):
        return None
    head = dynamics.head
    if not isinstance(head, ContactLaw) or head.turn_length is not None:  # pins join far bodies
        return None
    return InteractionCutoff(model.cutoff.outer, model.dt)
