"""Two rates: feedback at a kilohertz, and planning beside it that never holds it up."""

from contactgraph.robot.loop.clock import Clock as Clock
from contactgraph.robot.loop.clock import WallClock as WallClock
from contactgraph.robot.loop.control_loop import ControlLoop as ControlLoop
from contactgraph.robot.loop.control_loop import OnTick as OnTick
from contactgraph.robot.loop.laws import FeedbackLaw as FeedbackLaw
from contactgraph.robot.loop.laws import HeldForce as HeldForce
from contactgraph.robot.loop.planner import Law as Law
from contactgraph.robot.loop.planner import Moment as Moment
from contactgraph.robot.loop.planner import Planner as Planner
from contactgraph.robot.loop.planner import Start as Start
from contactgraph.robot.loop.planning import Planned as Planned
from contactgraph.robot.loop.planning import Planning as Planning
from contactgraph.robot.loop.planning_process import PlanningProcess as PlanningProcess
from contactgraph.robot.loop.report import LoopReport as LoopReport
