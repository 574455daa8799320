"""The model: which edges are active, and how the nodes move given that."""

from contactgraph.model.belief import ContactBelief as ContactBelief
from contactgraph.model.belief import ContactSensor as ContactSensor
from contactgraph.model.belief import correct as correct
from contactgraph.model.belief import two_type_belief as two_type_belief
from contactgraph.model.contact_dynamics import ContactDynamics as ContactDynamics
from contactgraph.model.linear_dynamics import LinearDynamics as LinearDynamics
from contactgraph.model.linear_dynamics import stack_state as stack_state
from contactgraph.model.linear_dynamics import unstack_state as unstack_state
from contactgraph.model.presets import full_ab as full_ab
from contactgraph.model.presets import gim_non_temp as gim_non_temp
from contactgraph.model.presets import gim_temp as gim_temp
from contactgraph.model.presets import no_gim as no_gim
from contactgraph.model.presets import paper_literal as paper_literal
from contactgraph.model.state import ModelState as ModelState
from contactgraph.model.state import Nodes as Nodes
