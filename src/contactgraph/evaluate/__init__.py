"""Running episodes, and the metrics over what was recorded."""

from contactgraph.envs.episodes import collect as collect
from contactgraph.envs.episodes import episode_seeds as episode_seeds
from contactgraph.envs.episodes import run_episode as run_episode
from contactgraph.evaluate.closed_loop import ClosedLoopMetrics as ClosedLoopMetrics
from contactgraph.evaluate.closed_loop import closed_loop_metrics as closed_loop_metrics
from contactgraph.evaluate.closed_loop import control_task as control_task
from contactgraph.evaluate.edge_scores import EstimatedContacts as EstimatedContacts
from contactgraph.evaluate.edge_scores import estimated_contacts as estimated_contacts
from contactgraph.evaluate.model_diagnostics import ModelDiagnostics as ModelDiagnostics
from contactgraph.evaluate.model_diagnostics import RolloutGrowth as RolloutGrowth
from contactgraph.evaluate.model_diagnostics import model_diagnostics as model_diagnostics
from contactgraph.evaluate.model_diagnostics import rollout_growth as rollout_growth
from contactgraph.evaluate.mpc_policy import MPCPolicy as MPCPolicy
from contactgraph.evaluate.mpc_policy import SceneCost as SceneCost
from contactgraph.evaluate.mpc_policy import TaskCost as TaskCost
from contactgraph.evaluate.open_loop import OpenLoopMetrics as OpenLoopMetrics
from contactgraph.evaluate.open_loop import evaluate_open_loop as evaluate_open_loop
from contactgraph.evaluate.plan_tracking import EpisodeRecord as EpisodeRecord
from contactgraph.evaluate.plan_tracking import PlanTrackingError as PlanTrackingError
from contactgraph.evaluate.plan_tracking import plan_tracking_error as plan_tracking_error
from contactgraph.evaluate.prediction_windows import OpenLoopDetail as OpenLoopDetail
from contactgraph.evaluate.sensor_faults import ObservationNoise as ObservationNoise
from contactgraph.evaluate.sensor_faults import SensorFaults as SensorFaults
from contactgraph.evaluate.statistics import MedianInterval as MedianInterval
from contactgraph.evaluate.statistics import median_interval as median_interval
from contactgraph.evaluate.statistics import wilson_interval as wilson_interval
