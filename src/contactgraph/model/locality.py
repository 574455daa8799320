"""How far a model's edges reach: what tells who can matter to whom."""

from dataclasses import dataclass

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.coupled_head import CoupledHead
from contactgraph.model.inference import AllEdges
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.message_passing import EdgeNetwork
from contactgraph.model.reach import Reach

_UNDRIVEN = 1e-3
"""1/kg; a control of 10 N then moves a bystander by 5 mm in a second."""


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
    """None where it is not so, or nobody knows: any object can be planned with.

    Edges may have no end; what an edge does may depend on its ends' other neighbours (messages in
    rounds), so that there is no telling how far it reaches; nodes may move of themselves (free
    matrices, the paper's head with its free equilibria); or the model has not learned that controls
    do not act on bystanders.
    """
    if not isinstance(model, ContactDynamics) or not isinstance(model.reach, Reach):
        return None
    dynamics, inference = model.local_dynamics, model.inference
    if not isinstance(dynamics, SpringMassDamperDynamics):
        return None
    networks = list(dynamics.message_passing.types)
    if not isinstance(inference, AllEdges):
        networks.append(inference.message_passing)
    if not all(isinstance(network, EdgeNetwork) for network in networks):
        return None
    head = dynamics.head
    # The first kind of node is neither actuated nor hinged.
    if not isinstance(head, CoupledHead) or not head.lone_response[0] <= _UNDRIVEN:
        return None
    return Locality(model.reach.far, model.dt)
