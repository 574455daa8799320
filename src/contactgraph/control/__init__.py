"""Plans and controls through contact, with any model that offers a linear step."""

from contactgraph.control.control_step import ControlLimits as ControlLimits
from contactgraph.control.cost import Cost as Cost
from contactgraph.control.cost import QuadraticCost as QuadraticCost
from contactgraph.control.cost import chain_cost as chain_cost
from contactgraph.control.cost_recipe import CostRecipe as CostRecipe
from contactgraph.control.differentiable_lqr import LQRTrajectory as LQRTrajectory
from contactgraph.control.differentiable_lqr import lqr_trajectory as lqr_trajectory
from contactgraph.control.differentiable_lqr import tracking_problem as tracking_problem
from contactgraph.control.ilqr import ILQR as ILQR
from contactgraph.control.learn_cost import learn_cost as learn_cost
from contactgraph.control.learned_cost import LearnedCost as LearnedCost
from contactgraph.control.learned_cost import LearningHistory as LearningHistory
from contactgraph.control.learned_cost import Participant as Participant
from contactgraph.control.lqr import LQRPolicy as LQRPolicy
from contactgraph.control.lqr import LQRProblem as LQRProblem
from contactgraph.control.lqr import QuadraticValue as QuadraticValue
from contactgraph.control.lqr import solve_lqr as solve_lqr
from contactgraph.control.mpc import MPC as MPC
from contactgraph.control.plan import Plan as Plan
from contactgraph.control.plan import PlanStatus as PlanStatus
from contactgraph.control.plan import shift_plan as shift_plan
from contactgraph.control.tick import MPCState as MPCState
