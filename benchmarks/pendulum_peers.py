"""The pendulum's swing-up as mpc.pytorch and crocoddyl solve it; see `pendulum`."""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from comparing import Missing
from pendulum import (
    CONTROL_WEIGHT,
    DT,
    GOAL,
    GRAVITY,
    HORIZON,
    LAST,
    STATE_WEIGHT,
    Solver,
)


def with_mpc() -> Solver | Missing:
    """mpc.pytorch, told the dynamics' derivatives; all starts side by side."""
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
    """crocoddyl's DDP: with a model in Python, and with pinocchio's in C++; starts in turn."""
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
            ways = [(crocoddyl.SolverDDP(each), each.rollout(guess)) for each in problems]

            def run() -> list[Any]:
                for ddp, states in ways:
                    ddp.solve(states, guess, iterations, True)
                return [ddp.us for ddp, _ in ways]

            return run

        return Solver(
            name, prepared, lambda answer: np.array([np.array(list(us))[:, 0] for us in answer])
        )

    return [
        solver(
            f"{name}, C++ model",
            lambda: compiled(1.0, CONTROL_WEIGHT, DT),
            compiled(LAST, 0.0, 0.0),
        ),
        solver(f"{name}, Python model", lambda: Action(1.0, CONTROL_WEIGHT), Action(LAST, 0.0)),
    ]
