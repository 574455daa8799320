"""Simulated tasks and the scripted experts that record them."""

from contactgraph.envs.adapter import AdaptedTask as AdaptedTask
from contactgraph.envs.billiards import BilliardsTask as BilliardsTask
from contactgraph.envs.billiards_policies import BilliardsExpert as BilliardsExpert
from contactgraph.envs.billiards_policies import StrikingPolicy as StrikingPolicy
from contactgraph.envs.check_task import check_task as check_task
from contactgraph.envs.contract import ChainCost as ChainCost
from contactgraph.envs.contract import Observation as Observation
from contactgraph.envs.contract import Policy as Policy
from contactgraph.envs.contract import Renderable as Renderable
from contactgraph.envs.contract import Task as Task
from contactgraph.envs.door import DoorTask as DoorTask
from contactgraph.envs.environment_map import Entries as Entries
from contactgraph.envs.environment_map import EnvironmentMap as EnvironmentMap
from contactgraph.envs.environment_map import MappedBody as MappedBody
from contactgraph.envs.environment_map import MappedControl as MappedControl
from contactgraph.envs.experts import DoorExpert as DoorExpert
from contactgraph.envs.experts import ExplorationPolicy as ExplorationPolicy
from contactgraph.envs.experts import PickupExpert as PickupExpert
from contactgraph.envs.experts import RestPolicy as RestPolicy
from contactgraph.envs.pick_policy import PickPolicy as PickPolicy
from contactgraph.envs.pickup import MultiPickupTask as MultiPickupTask
from contactgraph.envs.pickup import PickupTask as PickupTask
from contactgraph.envs.pickup import pickup_success as pickup_success
from contactgraph.envs.push_policy import PushPolicy as PushPolicy
from contactgraph.envs.push_policy import PushStyle as PushStyle
from contactgraph.envs.push_policy import RandomPushes as RandomPushes
