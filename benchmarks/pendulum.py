"""The pendulum's swing-up for the benchmarks, and its solvers: ours, mpc.pytorch, crocoddyl.

A point mass of 1 kg on a massless rod of 1 m, hanging at angle 0, is to stand at pi. State
[angle rad, rate rad/s], control a torque [N m]; `HORIZON` steps of `DT`, semi-implicit Euler as in
crocoddyl's integrator: the rate first, then the angle with the new rate. The cost of a step is
``1.0 (angle - pi)^2 + 0.1 rate^2 + 0.1 torque^2``, of the last state a hundred times its first two
terms. The first guess is no torque.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import Method, Missing

from contactgraph.control import ILQR, QuadraticCost
from contactgraph.model import ContactBelief, LinearDynamics, ModelState, Nodes

HORIZON, DT = 100, 0.03
GRAVITY = 9.81
STATE_WEIGHT = np.array([1.0, 0.1])
CONTROL_WEIGHT = 0.1
LAST = 100.0
GOAL = np.array([np.pi, 0.0])
NEAR = 1e-4
"""A solver is done when its cost is above the least by no more than this part."""
TRIED = (10, 15, 20, 25, 30, 40, 50, 60)
"""Numbers of iterations."""
MANY = 200
"""Iterations after which nothing changes any more."""


@dataclass(frozen=True)
class Solver:
    """Solves the swing-up from several starts [batch, 2] with at most so many iterations."""

    name: str
    prepared: Callable[[np.ndarray, int], Callable[[], Any]]
    """From the starts and the iterations to what is timed."""
    controls: Callable[[Any], np.ndarray]
    """[batch, H] N m, of what that returned."""


def total_cost(starts: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """[batch] The cost of controls [batch, H], the same sum in double precision for all solvers."""
    angle, rate = starts.astype(float).T
    total = np.zeros(len(starts))
    for torque in controls.T:
        total += _state_cost(angle, rate) + CONTROL_WEIGHT * torque**2
        rate = rate + DT * (torque - GRAVITY * np.sin(angle))
        angle = angle + DT * rate
    return total + LAST * _state_cost(angle, rate)


def _state_cost(angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return STATE_WEIGHT[0] * (angle - GOAL[0]) ** 2 + STATE_WEIGHT[1] * (rate - GOAL[1]) ** 2


def enough_iterations(solver: Solver, starts: np.ndarray, least: np.ndarray) -> int | None:
    """The first tried number with which a solver is within `NEAR` of these costs."""
    for iterations in TRIED:
        controls = solver.controls(solver.prepared(starts, iterations)())
        if np.all(total_cost(starts, controls) <= (1.0 + NEAR) * least):
            return iterations
    return None


def method(solver: Solver, starts: np.ndarray, iterations: int) -> Method:
    """The timed method; its answer is the cost from every start."""

    def cost(returned: Any) -> np.ndarray:
        return total_cost(starts, solver.controls(returned))

    return Method(f"{solver.name}, {iterations} it.", solver.prepared(starts, iterations), cost)


class Pendulum(eqx.Module):
    """The pendulum as `ILQR` takes a model: one node with one degree of freedom, the angle."""

    def linear_step(
        self, state: ModelState, control: jax.Array, nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]:
        """The step, linear about the state; exact in the control."""
        angle, rate = state.position[0, 0], state.velocity[0, 0]
        slope = -GRAVITY * jnp.cos(angle)
        fall = -GRAVITY * jnp.sin(angle)
        A = jnp.array([[1.0 + DT**2 * slope, DT], [DT * slope, 1.0]])
        after = jnp.array([angle + DT * (rate + DT * fall), rate + DT * fall])
        offset = after - jnp.sum(A * jnp.array([angle, rate]), axis=-1)
        B = jnp.array([[DT**2], [DT]])
        return LinearDynamics(A[None, None], B[None, None], offset[None, None]), state.belief

    def initial_belief(self, position: jax.Array, velocity: jax.Array, nodes: Nodes) -> Any:
        """About no edges."""
        return ContactBelief(jnp.zeros((0, 2)))


def _planned(starts: np.ndarray, iterations: int) -> Callable[[], Any]:
    ilqr = ILQR(horizon=HORIZON, iterations=iterations, tolerance=0.0, absolute_tolerance=0.0)
    nodes = Nodes(jnp.ones(1, bool), jnp.ones(1, bool), jnp.ones(0, bool))
    cost = QuadraticCost(
        Q=jnp.asarray(np.diag(STATE_WEIGHT)),
        R=jnp.full((1, 1), CONTROL_WEIGHT),
        goal=jnp.asarray(GOAL),
        terminal_weight=jnp.asarray(LAST),
    )
    model, belief = Pendulum(), ContactBelief(jnp.zeros((0, 2)))

    def controls(start: jax.Array) -> jax.Array:
        state = ModelState(start[:1, None], start[1:, None], belief)
        return ilqr.solve(model, state, nodes, cost).controls[:, 0]

    # One start is solved without a batch, as a controller does.
    placed = jnp.asarray(starts[0] if len(starts) == 1 else starts, jnp.float32)
    solve = jax.jit(controls if len(starts) == 1 else jax.vmap(controls))
    return lambda: jax.block_until_ready(solve(placed))


OURS = Solver("ours", _planned, lambda answer: np.asarray(answer, float).reshape(-1, HORIZON))


def with_mpc() -> Solver | Missing:
    """mpc.pytorch with the dynamics' derivatives; all starts side by side."""
    try:
        import torch
        from mpc import mpc
    except ImportError as missing:
        return Missing("mpc", str(missing))
    torch.set_num_threads(1)

    class Dynamics(torch.nn.Module):
        def forward(self, x: Any, u: Any) -> Any:
            rate = x[:, 1] + DT * (u[:, 0] - GRAVITY * torch.sin(x[:, 0]))
            return torch.stack([x[:, 0] + DT * rate, rate], dim=1)

        def grad_input(self, x: Any, u: Any) -> Any:
            slope = -GRAVITY * torch.cos(x[:, 0])
            one = torch.ones_like(slope)
            A = torch.stack([1.0 + DT**2 * slope, DT * one, DT * slope, one], dim=1)
            B = torch.stack([DT**2 * one, DT * one], dim=1)
            return A.reshape(-1, 2, 2), B[:, :, None]

    def prepared(starts: np.ndarray, iterations: int) -> Callable[[], Any]:
        batch = len(starts)
        weight = np.concatenate([STATE_WEIGHT, [CONTROL_WEIGHT]])
        C = torch.tensor(2 * np.diag(weight), dtype=torch.float32)  # Its cost is half of x^T C x.
        C = C.repeat(HORIZON + 1, batch, 1, 1)
        C[-1, :, :2, :2] *= LAST
        c = -torch.einsum("tbij,j->tbi", C, torch.tensor([*GOAL, 0.0], dtype=torch.float32))
        first = torch.tensor(starts, dtype=torch.float32)
        solver = mpc.MPC(
            2,
            1,
            HORIZON + 1,
            lqr_iter=iterations,
            grad_method=mpc.GradMethods.ANALYTIC,
            n_batch=batch,
            verbose=-1,
            exit_unconverged=False,
            detach_unconverged=False,
            backprop=False,
        )
        return lambda: solver(first, mpc.QuadCost(C, c), Dynamics())

    def controls(answer: Any) -> np.ndarray:
        return answer[1].detach().numpy()[:HORIZON, :, 0].T.astype(float)

    return Solver(f"mpc {version('mpc')}", prepared, controls)


def with_crocoddyl() -> list[Solver | Missing]:
    """crocoddyl's DDP, starts in turn: with the step and cost written by hand in C++
    (`pendulum_action.cpp`), with pinocchio's general ones in C++, and with ones in Python."""
    try:
        import crocoddyl
        import pinocchio
    except ImportError as missing:
        return [Missing("crocoddyl", str(missing))]
    name = f"crocoddyl {version('crocoddyl')} DDP"

    class Action(crocoddyl.ActionModelAbstract):
        """The same step and cost in Python."""

        def __init__(self, factor: float, control: float) -> None:
            crocoddyl.ActionModelAbstract.__init__(self, crocoddyl.StateVector(2), 1, 1)
            self.weight, self.control = factor * STATE_WEIGHT, control

        def calc(self, data: Any, x: Any, u: Any = None) -> None:
            torque = 0.0 if u is None else u[0]
            rate = x[1] + DT * (torque - GRAVITY * np.sin(x[0]))
            data.xnext = np.array([x[0] + DT * rate, rate])
            data.cost = float(np.sum(self.weight * (x - GOAL) ** 2) + self.control * torque**2)

        def calcDiff(self, data: Any, x: Any, u: Any = None) -> None:
            torque = 0.0 if u is None else u[0]
            slope = -GRAVITY * np.cos(x[0])
            data.Fx = np.array([[1.0 + DT**2 * slope, DT], [DT * slope, 1.0]])
            data.Fu = np.array([DT**2, DT])
            data.Lx, data.Lxx = 2 * self.weight * (x - GOAL), 2 * np.diag(self.weight)
            data.Lu, data.Luu = np.array([2 * self.control * torque]), np.full((1, 1), 2.0)
            data.Luu = data.Luu * self.control

    robot = pinocchio.Model()
    joint = robot.addJoint(0, pinocchio.JointModelRX(), pinocchio.SE3.Identity(), "pivot")
    mass = pinocchio.Inertia(1.0, np.array([0.0, 0.0, -1.0]), np.zeros((3, 3)))
    robot.appendBodyToJoint(joint, mass, pinocchio.SE3.Identity())
    state = crocoddyl.StateMultibody(robot)

    def compiled(factor: float, control: float, step: float) -> Any:
        # Its integrator multiplies the cost by the step, where there is one.
        costs = crocoddyl.CostModelSum(state, 1)
        weight = crocoddyl.ActivationModelWeightedQuad(2 * factor * STATE_WEIGHT / (step or 1.0))
        goal = crocoddyl.ResidualModelState(state, GOAL, 1)
        costs.addCost("state", crocoddyl.CostModelResidual(state, weight, goal), 1.0)
        torque = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state, 1))
        if control:
            costs.addCost("control", torque, 2 * control / step)
        free = crocoddyl.DifferentialActionModelFreeFwdDynamics(
            state, crocoddyl.ActuationModelFull(state), costs
        )
        # Without it, crocoddyl 3.2.1 with pinocchio 4.1 leaves out gravity.
        free.armature = np.zeros(1)
        return crocoddyl.IntegratedActionModelEuler(free, step)

    def solver(name: str, running: Callable[[], Any], last: Any) -> Solver:
        def prepared(starts: np.ndarray, iterations: int) -> Callable[[], Any]:
            guess = [np.zeros(1)] * HORIZON
            problems = [
                crocoddyl.ShootingProblem(start, [running() for _ in range(HORIZON)], last)
                for start in starts.astype(float)
            ]
            solvers = [(crocoddyl.SolverDDP(each), each.rollout(guess)) for each in problems]

            def run() -> list[Any]:
                for ddp, states in solvers:
                    ddp.solve(states, guess, iterations, True)
                return [ddp.us for ddp, _ in solvers]

            return run

        return Solver(
            name, prepared, lambda answer: np.array([np.array(list(us))[:, 0] for us in answer])
        )

    written: Solver | Missing
    try:
        from pendulum_action import PendulumAction
    except ImportError as missing:
        written = Missing(f"{name}, hand-written C++ model", str(missing))
    else:

        def by_hand(factor: float, control: float) -> Any:
            return PendulumAction(*factor * STATE_WEIGHT, control, GOAL[0], DT, GRAVITY)

        written = solver(
            f"{name}, hand-written C++ model",
            lambda: by_hand(1.0, CONTROL_WEIGHT),
            by_hand(LAST, 0.0),
        )
    return [
        written,
        solver(
            f"{name}, pinocchio's general C++ model",
            lambda: compiled(1.0, CONTROL_WEIGHT, DT),
            compiled(LAST, 0.0, 0.0),
        ),
        solver(f"{name}, Python model", lambda: Action(1.0, CONTROL_WEIGHT), Action(LAST, 0.0)),
    ]
