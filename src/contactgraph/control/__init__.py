"""Plans and controls through contact, with any model that offers a linear step."""

from contactgraph.control.active_set import ActiveSetMPC as ActiveSetMPC
from contactgraph.control.box_qp import AffinePolicy as AffinePolicy
from contactgraph.control.box_qp import ControlLimits as ControlLimits
from contactgraph.control.contact_cost import BeliefCost as BeliefCost
from contactgraph.control.contact_cost import ContactCost as ContactCost
from contactgraph.control.contact_cost import DistanceCost as DistanceCost
from contactgraph.control.contact_cost import avoid as avoid
from contactgraph.control.contact_cost import hold as hold
from contactgraph.control.contact_cost import keep_clear as keep_clear
from contactgraph.control.contact_cost import touch as touch
from contactgraph.control.cost import Cost as Cost
from contactgraph.control.cost import QuadraticCost as QuadraticCost
from contactgraph.control.cost import chain_cost as chain_cost
from contactgraph.control.cost_io import describe_cost as describe_cost
from contactgraph.control.cost_io import read_cost as read_cost
from contactgraph.control.cost_io import write_cost as write_cost
from contactgraph.control.cost_learner import learn_cost as learn_cost
from contactgraph.control.host import compile_small_loops as compile_small_loops
from contactgraph.control.host import pin_to_core as pin_to_core
from contactgraph.control.ilqr import ILQR as ILQR
from contactgraph.control.ilqr import PlanningProblem as PlanningProblem
from contactgraph.control.learned_cost import CostLearningConfig as CostLearningConfig
from contactgraph.control.learned_cost import CostTerm as CostTerm
from contactgraph.control.learned_cost import LearnedContact as LearnedContact
from contactgraph.control.learned_cost import LearnedCost as LearnedCost
from contactgraph.control.learned_cost import TaskNode as TaskNode
from contactgraph.control.learned_cost import cost_terms as cost_terms
from contactgraph.control.lqr import QuadraticValue as QuadraticValue
from contactgraph.control.lqr import solve_lqr as solve_lqr
from contactgraph.control.lqr import tracking_problem as tracking_problem
from contactgraph.control.lqr_adjoint import LQRTrajectory as LQRTrajectory
from contactgraph.control.lqr_adjoint import lqr_trajectory as lqr_trajectory
from contactgraph.control.mpc import MPC as MPC
from contactgraph.control.multi_start import Leap as Leap
from contactgraph.control.multi_start import MultiStartILQR as MultiStartILQR
from contactgraph.control.multi_start import Proposal as Proposal
from contactgraph.control.multi_start import Starts as Starts
from contactgraph.control.plan import Plan as Plan
from contactgraph.control.plan import Planner as Planner
from contactgraph.control.plan import PlanStatus as PlanStatus
from contactgraph.control.plan import shift_plan as shift_plan
from contactgraph.control.program_store import note_bindings
from contactgraph.control.proposals.approaches import Approaches as Approaches
from contactgraph.control.proposals.approaches import searches as searches
from contactgraph.control.proposals.routes import Routes as Routes
from contactgraph.control.proposals.schedules import ChangingSchedules as ChangingSchedules
from contactgraph.control.proposals.schedules import ConstantSchedule as ConstantSchedule
from contactgraph.control.proposals.short_plans import ShortPlans as ShortPlans
from contactgraph.control.riccati import LQRProblem as LQRProblem
from contactgraph.control.subproblem import MPCState as MPCState
from contactgraph.control.subproblem import interaction_cutoff as interaction_cutoff

_TRACED = "data", "bodies", "inference", "dynamics", "model", "control"
note_bindings(*(f"contactgraph.{each}" for each in _TRACED))
