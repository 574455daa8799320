"""Where work is done: in processes of this machine, or on a cluster of machines."""

from contactgraph.parallel.engine import Crew as Crew
from contactgraph.parallel.engine import Engine as Engine
from contactgraph.parallel.engine import Outcome as Outcome
from contactgraph.parallel.engine import answers_in_order as answers_in_order
from contactgraph.parallel.processes import LocalProcesses as LocalProcesses
from contactgraph.parallel.processes import usable_cores as usable_cores
from contactgraph.parallel.whole_machine import WholeMachine as WholeMachine
