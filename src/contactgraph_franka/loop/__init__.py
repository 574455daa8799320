"""Two rates: feedback at a kilohertz, and planning beside it that never holds it up."""

from contactgraph_franka.loop.clock import Clock as Clock
from contactgraph_franka.loop.clock import WallClock as WallClock
from contactgraph_franka.loop.control_loop import ControlLoop as ControlLoop
from contactgraph_franka.loop.control_loop import OnTick as OnTick
from contactgraph_franka.loop.laws import FeedbackLaw as FeedbackLaw
from contactgraph_franka.loop.laws import HeldForce as HeldForce
from contactgraph_franka.loop.planner import Law as Law
from contactgraph_franka.loop.planner import Moment as Moment
from contactgraph_franka.loop.planner import Planner as Planner
from contactgraph_franka.loop.planner import Start as Start
from contactgraph_franka.loop.planning import Planned as Planned
from contactgraph_franka.loop.planning import Planning as Planning
from contactgraph_franka.loop.planning_process import PlanningProcess as PlanningProcess
from contactgraph_franka.loop.report import LoopReport as LoopReport
