"""How long an optimal trajectory and its gradients take, beside other ways to get them.

Usage: python benchmarks/differentiable_lqr.py [--quick] [--json FILE]

One forward pass and one backward pass, for given slopes of the loss, through 200 steps of 40
problems with 8 states and 2 controls, on one core: by the adjoint rule of `lqr_trajectory`, by
autodiff through the same Riccati scan, and by mpc.pytorch (package ``mpc``) with its own implicit
rule, told that one LQR step is enough. Gradients are with respect to dynamics, cost and start.
The ways take turns, so that whatever else the machine does meets all of them. ``mpc`` needs an
environment of its own: ``make bench-peers``; without it its row is left out.
"""

import os

if hasattr(os, "sched_setaffinity"):  # Before JAX and torch count the cores.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measuring import arguments, report

from contactgraph.control import LQRProblem, LQRTrajectory, lqr_trajectory, solve_lqr

HORIZON, STATES, CONTROLS, BATCH = 200, 8, 2, 40
Answer = tuple[LQRTrajectory, tuple[LQRProblem, jax.Array]]
"""The trajectory, and the gradients."""


def sample() -> tuple[LQRProblem, np.ndarray, LQRTrajectory]:
    """Problems, starts and slopes of a loss, all [BATCH, ...]."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(size=(BATCH, *shape)).astype(np.float32)

    def positive(steps: int, size: int) -> np.ndarray:
        root = normal(steps, size, size)
        return 0.1 * root @ root.swapaxes(-1, -2) + np.eye(size, dtype=np.float32)

    problem = LQRProblem(
        A=np.eye(STATES, dtype=np.float32) + 0.05 * normal(HORIZON, STATES, STATES),
        B=normal(HORIZON, STATES, CONTROLS),
        offset=0.1 * normal(HORIZON, STATES),
        Q=positive(HORIZON + 1, STATES),
        R=positive(HORIZON, CONTROLS),
        q=normal(HORIZON + 1, STATES),
        r=normal(HORIZON, CONTROLS),
    )
    slopes = LQRTrajectory(normal(HORIZON + 1, STATES), normal(HORIZON, CONTROLS))
    return problem, normal(STATES), slopes


def through_the_scan(problem: LQRProblem, start: jax.Array) -> LQRTrajectory:
    """The same trajectory in plain JAX, for autodiff."""
    policy, _ = solve_lqr(problem)

    def step(x: jax.Array, stage: tuple) -> tuple[jax.Array, tuple]:
        A, B, offset, policy = stage
        u = policy(x)
        return A @ x + B @ u + offset, (x, u)

    stages = (problem.A, problem.B, problem.offset, policy)
    last, (states, controls) = jax.lax.scan(step, start, stages)
    return LQRTrajectory(jnp.concatenate([states, last[None]]), controls)


def with_jax(solver: Callable, axis: int, data: tuple) -> Callable[[], Answer]:
    """One run of a solver, the batch kept in this axis of every array."""
    placed = jax.tree.map(lambda leaf: jnp.asarray(np.moveaxis(leaf, 0, axis)), data)

    @jax.jit
    def both(problem: LQRProblem, start: jax.Array, slopes: LQRTrajectory) -> Answer:
        batched = jax.vmap(solver, in_axes=axis, out_axes=axis)
        trajectory, pull = jax.vjp(batched, problem, start)
        return trajectory, pull(slopes)

    return lambda: jax.block_until_ready(both(*placed))


def with_mpc(data: tuple) -> tuple[str, Callable[[], Any], Callable[[Any], Answer]] | None:
    """Its name, one run, and what a run returned as an `Answer`; None if it is not installed."""
    try:
        import torch
        from mpc import mpc
    except ImportError as missing:
        print(f"mpc.pytorch is left out: {missing} (make bench-peers installs it apart)")
        return None
    torch.set_num_threads(1)
    problem, start, slopes = data
    n, steps = STATES, HORIZON + 1  # It has a control after the last step, too: ours is zero.
    cost = np.zeros((BATCH, steps, n + CONTROLS, n + CONTROLS), np.float32)
    cost[..., :n, :n], cost[:, :-1, n:, n:] = problem.Q, problem.R
    cost[:, -1, n:, n:] = np.eye(CONTROLS)
    linear = np.zeros((BATCH, steps, n + CONTROLS), np.float32)
    linear[..., :n], linear[:, :-1, n:] = problem.q, problem.r
    dynamics = np.concatenate([problem.A, problem.B], axis=-1)
    x_slope, u_slope = slopes.states, np.pad(slopes.controls, ((0, 0), (0, 1), (0, 0)))

    def tensor(array: np.ndarray) -> Any:
        return torch.tensor(np.ascontiguousarray(array.swapaxes(0, 1)), requires_grad=True)

    C, c, F, f = (tensor(array) for array in (cost, linear, dynamics, problem.offset))
    first = torch.tensor(start, requires_grad=True)
    along = [tensor(x_slope).detach(), tensor(u_slope).detach()]
    solver = mpc.MPC(
        n,
        CONTROLS,
        steps,
        lqr_iter=1,
        max_linesearch_iter=1,
        verbose=-1,
        exit_unconverged=False,
        detach_unconverged=False,
    )

    def run() -> Any:
        states, controls, _ = solver(first, mpc.QuadCost(C, c), mpc.LinDx(F, f))
        return states, controls, torch.autograd.grad([states, controls], [C, c, F, f, first], along)

    def answer(returned: Any) -> Answer:
        states, controls, slopes = returned
        states, controls, dC, dc, dF, df = (
            array.detach().numpy().swapaxes(0, 1) for array in (states, controls, *slopes[:4])
        )
        gradients = LQRProblem(
            A=dF[..., :n],
            B=dF[..., n:],
            offset=df,
            Q=dC[..., :n, :n],
            R=dC[:, :-1, n:, n:],
            q=dc[..., :n],
            r=dc[:, :-1, n:],
        )
        return LQRTrajectory(states, controls[:, :-1]), (gradients, slopes[4].numpy())

    name = f"mpc {version('mpc')}, torch {torch.__version__}, {torch.get_num_threads()} thread"
    return name, run, answer


def difference(answer: Any, reference: Any) -> float:
    """The largest over all leaves, as a fraction of the leaf's largest entry."""
    parts = jax.tree.map(lambda a, b: np.max(np.abs(a - b)) / np.max(np.abs(b)), answer, reference)
    return float(max(jax.tree.leaves(parts)))


def symmetric(answer: Answer) -> Answer:
    """Autodiff tells the two halves of Q and R apart; the adjoint rule does not."""
    return eqx.tree_at(
        lambda both: (both[1][0].Q, both[1][0].R),
        answer,
        replace_fn=lambda slope: 0.5 * (slope + slope.swapaxes(-1, -2)),
    )


def main() -> None:
    """Measure and say."""
    told = arguments("Time of a differentiable LQR, forwards and backwards.")
    data = sample()
    ours, first = "adjoint rule", "adjoint rule, batch first"
    runs: dict[str, Callable[[], Any]] = {
        ours: with_jax(lqr_trajectory, -1, data),
        first: with_jax(lqr_trajectory, 0, data),
        "autodiff of the scan": with_jax(through_the_scan, 0, data),
    }
    to_answer: dict[str, Callable[[Any], Answer]] = {
        ours: lambda given: jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), given),
        first: lambda given: given,
        "autodiff of the scan": symmetric,
    }
    if (peer := with_mpc(data)) is not None:
        runs[peer[0]], to_answer[peer[0]] = peer[1], peer[2]

    answers = {name: to_answer[name](run()) for name, run in runs.items()}  # compiles, too
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(3 if told.quick else 30):
        for name, run in runs.items():
            run()  # With its own data and code in the caches again.
            began = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - began)
    rows = [
        {
            "way": name,
            "median ms": 1e3 * float(np.median(seconds[name])),
            "fastest ms": 1e3 * min(seconds[name]),
            "times as long": float(np.median(np.divide(seconds[name], seconds[ours]))),
            "trajectory differs by": f"{difference(answer[0], answers[ours][0]):.0e}",
            "gradients differ by": f"{difference(answer[1], answers[ours][1]):.0e}",
        }
        for name, answer in answers.items()
    ]
    report("differentiable_lqr", rows, told)


if __name__ == "__main__":
    main()
