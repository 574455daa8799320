"""Simulated tasks and the scripted experts that record them."""

from contactgraph.tasks.check_task import check_task as check_task
from contactgraph.tasks.contract import ChainCost as ChainCost
from contactgraph.tasks.contract import Drawn as Drawn
from contactgraph.tasks.contract import Observation as Observation
from contactgraph.tasks.contract import Policy as Policy
from contactgraph.tasks.contract import Task as Task
from contactgraph.tasks.door import DoorTask as DoorTask
from contactgraph.tasks.door_expert import DoorExpert as DoorExpert
from contactgraph.tasks.excitation import ExplorationPolicy as ExplorationPolicy
from contactgraph.tasks.excitation import RestPolicy as RestPolicy
from contactgraph.tasks.expert import PickupExpert as PickupExpert
from contactgraph.tasks.franka_expert import FrankaExpert as FrankaExpert
from contactgraph.tasks.multi_pickup import MultiPickupTask as MultiPickupTask
from contactgraph.tasks.pickup import PickupTask as PickupTask
from contactgraph.tasks.pickup import pickup_success as pickup_success
