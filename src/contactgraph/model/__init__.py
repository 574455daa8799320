"""The model: which edges are active, and how the nodes move given that."""

from contactgraph.model.belief import ContactBelief as ContactBelief
from contactgraph.model.belief import ContactSensor as ContactSensor
from contactgraph.model.belief import correct as correct
from contactgraph.model.belief import two_type_belief as two_type_belief
from contactgraph.model.linear_dynamics import LinearDynamics as LinearDynamics
from contactgraph.model.linear_dynamics import stack_state as stack_state
from contactgraph.model.linear_dynamics import unstack_state as unstack_state
from contactgraph.model.state import ModelState as ModelState
from contactgraph.model.state import Nodes as Nodes
