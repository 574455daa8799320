"""Affine LQR problems for the benchmarks, and crocoddyl's and mpc.pytorch's form of them."""

from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measuring import Method, Missing

from contactgraph.control import LQRProblem, LQRTrajectory, solve_lqr

HORIZON, CONTROLS = 200, 2


def sample(states: int, seed: int = 0) -> tuple[LQRProblem, np.ndarray, np.ndarray]:
    """A problem with dense A, the blocks [H, n/2, 2, 2] of A, and a start; float64.

    States are [position, velocity] of each degree of freedom, one after the other.
    """
    rng = np.random.default_rng(seed)
    count = states // 2
    blocks = np.eye(2) + 0.05 * rng.normal(size=(HORIZON, count, 2, 2))
    A = np.zeros((HORIZON, count, 2, count, 2))
    A[:, np.arange(count), :, np.arange(count)] = blocks.swapaxes(0, 1)

    def positive(steps: int, size: int) -> np.ndarray:
        root = rng.normal(size=(steps, size, size))
        return 0.1 / np.sqrt(size) * root @ root.swapaxes(-1, -2) + np.eye(size)

    problem = LQRProblem(
        A=A.reshape(HORIZON, states, states),
        B=rng.normal(size=(HORIZON, states, CONTROLS)),
        offset=0.1 * rng.normal(size=(HORIZON, states)),
        Q=positive(HORIZON + 1, states),
        R=positive(HORIZON, CONTROLS),
        q=rng.normal(size=(HORIZON + 1, states)),
        r=rng.normal(size=(HORIZON, CONTROLS)),
    )
    return problem, blocks, rng.normal(size=states)


def through_the_scan(problem: LQRProblem, start: jax.Array) -> LQRTrajectory:
    """The optimal trajectory from a start, in plain JAX: no derivative of our own."""
    policy, _ = solve_lqr(problem)

    def step(x: jax.Array, stage: tuple) -> tuple[jax.Array, tuple]:
        A, B, offset, policy = stage
        u = policy(x)
        return A @ x + B @ u + offset, (x, u)

    stages = (problem.A, problem.B, problem.offset, policy)
    last, (states, controls) = jax.lax.scan(step, start, stages)
    return LQRTrajectory(jnp.concatenate([states, last[None]]), controls)


def with_crocoddyl(problem: LQRProblem, start: np.ndarray) -> Method | Missing:
    """Its DDP in C++; one iteration is enough where dynamics are affine. Gives the controls."""
    try:
        import crocoddyl
    except ImportError as missing:
        return Missing("crocoddyl", str(missing))
    n = len(start)
    nothing = np.zeros((n, CONTROLS))

    def action(A: Any, B: Any, Q: Any, R: Any, offset: Any, q: Any, r: Any) -> Any:
        # Its cost is half of x^T Q x, and q^T x.
        return crocoddyl.ActionModelLQR(A, B, 2 * Q, 2 * R, nothing, offset, 2 * q, 2 * r)

    steps = zip(
        *(problem.A, problem.B, problem.Q, problem.R, problem.offset, problem.q, problem.r),
        strict=False,
    )
    last = action(
        np.eye(n), nothing, problem.Q[-1], np.eye(CONTROLS), 0 * start, problem.q[-1], nothing[0]
    )
    solver = crocoddyl.SolverDDP(
        crocoddyl.ShootingProblem(start, [action(*step) for step in steps], last)
    )
    states, controls = [start] * (HORIZON + 1), [nothing[0]] * HORIZON

    def run() -> Any:
        solver.solve(states, controls, 1, False, 0.0)
        return solver.us

    return Method(f"crocoddyl {version('crocoddyl')} DDP", run, lambda us: np.array(list(us)))


class MPCTorch:
    """A batch of problems as mpc.pytorch has them: tensors ``C, c, F, f, start``, time first.

    It has a control after the last step, too: ours is zero. It makes one LQR step.
    Raises `ImportError` where ``mpc`` or torch is not installed.
    """

    def __init__(self, problem: LQRProblem, start: np.ndarray) -> None:
        """``problem`` and ``start`` have a leading axis, the batch."""
        import torch
        from mpc import mpc

        torch.set_num_threads(1)
        self.name = f"mpc {version('mpc')}, torch {torch.__version__}"
        batch, horizon, n, U = problem.B.shape
        steps = horizon + 1
        cost = np.zeros((batch, steps, n + U, n + U))
        cost[..., :n, :n], cost[:, :-1, n:, n:] = problem.Q, problem.R
        cost[:, -1, n:, n:] = np.eye(U)
        linear = np.zeros((batch, steps, n + U))
        linear[..., :n], linear[:, :-1, n:] = problem.q, problem.r
        dynamics = np.concatenate([problem.A, problem.B], axis=-1)

        def tensor(array: np.ndarray) -> Any:
            return torch.tensor(np.ascontiguousarray(array.swapaxes(0, 1)), dtype=torch.float32)

        self.C, self.c, self.F, self.f = map(tensor, (cost, linear, dynamics, problem.offset))
        self.start = torch.tensor(start, dtype=torch.float32)
        self._cost, self._dynamics = mpc.QuadCost, mpc.LinDx
        self._solver = mpc.MPC(
            n,
            U,
            steps,
            lqr_iter=1,
            max_linesearch_iter=1,
            verbose=-1,
            exit_unconverged=False,
            detach_unconverged=False,
        )

    def solve(self) -> tuple[Any, Any]:
        """States and controls, time first."""
        states, controls, _ = self._solver(
            self.start, self._cost(self.C, self.c), self._dynamics(self.F, self.f)
        )
        return states, controls
