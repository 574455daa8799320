"""Policies of tasks: MPC with a learned model, its costs, and imperfect sensors."""

from contactgraph.policies.mpc_policy import EpisodeRecord as EpisodeRecord
from contactgraph.policies.mpc_policy import MPCPolicy as MPCPolicy
from contactgraph.policies.mpc_policy import RecordingPolicy as RecordingPolicy
from contactgraph.policies.mpc_policy import plan_feedback as plan_feedback
from contactgraph.policies.sensor_faults import ObservationNoise as ObservationNoise
from contactgraph.policies.sensor_faults import SensorFault as SensorFault
from contactgraph.policies.sensor_faults import SensorFaults as SensorFaults
from contactgraph.policies.task_cost import CandidateTrials as CandidateTrials
from contactgraph.policies.task_cost import SceneCost as SceneCost
from contactgraph.policies.task_cost import TaskCost as TaskCost
from contactgraph.policies.task_cost import avoid_others as avoid_others
from contactgraph.policies.task_policy import PlannerFactory as PlannerFactory
from contactgraph.policies.task_policy import Planning as Planning
from contactgraph.policies.task_policy import switches_of as switches_of
from contactgraph.policies.task_policy import task_policy as task_policy
