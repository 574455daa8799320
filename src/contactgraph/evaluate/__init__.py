"""Running episodes, and the metrics over what was recorded."""

from contactgraph.envs.collect import collect as collect
from contactgraph.envs.collect import episode_seeds as episode_seeds
from contactgraph.envs.run_episode import run_episode as run_episode
from contactgraph.evaluate.closed_loop import ClosedLoopMetrics as ClosedLoopMetrics
from contactgraph.evaluate.closed_loop import closed_loop_metrics as closed_loop_metrics
from contactgraph.evaluate.control_policy import EpisodeRecord as EpisodeRecord
from contactgraph.evaluate.control_policy import MPCPolicy as MPCPolicy
from contactgraph.evaluate.control_task import control_task as control_task
from contactgraph.evaluate.found_contacts import FoundContacts as FoundContacts
from contactgraph.evaluate.found_contacts import found_contacts as found_contacts
from contactgraph.evaluate.growth import RolloutGrowth as RolloutGrowth
from contactgraph.evaluate.growth import rollout_growth as rollout_growth
from contactgraph.evaluate.inspect_run import RunInsight as RunInsight
from contactgraph.evaluate.inspect_run import inspect_run as inspect_run
from contactgraph.evaluate.observation_noise import ObservationNoise as ObservationNoise
from contactgraph.evaluate.open_loop import OpenLoopMetrics as OpenLoopMetrics
from contactgraph.evaluate.open_loop import evaluate_open_loop as evaluate_open_loop
from contactgraph.evaluate.open_loop_detail import OpenLoopDetail as OpenLoopDetail
from contactgraph.evaluate.planned_error import PlannedError as PlannedError
from contactgraph.evaluate.planned_error import planned_error as planned_error
from contactgraph.evaluate.scene_cost import SceneCost as SceneCost
from contactgraph.evaluate.scene_cost import TaskCost as TaskCost
from contactgraph.evaluate.sensor_faults import SensorFaults as SensorFaults
from contactgraph.evaluate.statistics import MedianInterval as MedianInterval
from contactgraph.evaluate.statistics import median_interval as median_interval
from contactgraph.evaluate.statistics import wilson_interval as wilson_interval
