"""Where work is done: in processes of this machine, or on a cluster of machines."""

from contactgraph.cluster.engine import Crew as Crew
from contactgraph.cluster.engine import Engine as Engine
from contactgraph.cluster.engine import Outcome as Outcome
from contactgraph.cluster.engine import answers_in_order as answers_in_order
from contactgraph.cluster.processes import LocalProcesses as LocalProcesses
from contactgraph.cluster.processes import usable_cores as usable_cores
from contactgraph.cluster.whole_machine import WholeMachine as WholeMachine
