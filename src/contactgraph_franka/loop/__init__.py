"""The control loop at 1 kHz, and planners beside it that never block it."""

from contactgraph.feedback import PlanFeedback as PlanFeedback
from contactgraph_franka.loop.control_loop import ControlLoop as ControlLoop
from contactgraph_franka.loop.control_loop import CycleCallback as CycleCallback
from contactgraph_franka.loop.planner import AsyncPlanner as AsyncPlanner
from contactgraph_franka.loop.planner import ControlPolicy as ControlPolicy
from contactgraph_franka.loop.planner import EpisodeStart as EpisodeStart
from contactgraph_franka.loop.planner import Planner as Planner
from contactgraph_franka.loop.planner import PlanResult as PlanResult
from contactgraph_franka.loop.planner import TimedObservation as TimedObservation
from contactgraph_franka.loop.planner import ZeroOrderHold as ZeroOrderHold
from contactgraph_franka.loop.planner_process import PlannerProcess as PlannerProcess
from contactgraph_franka.loop.realtime import Clock as Clock
from contactgraph_franka.loop.realtime import WallClock as WallClock
from contactgraph_franka.loop.statistics import LoopReport as LoopReport
