"""How long one LQR problem takes to solve, beside crocoddyl's differential dynamic programming.

Usage: python benchmarks/lqr_solve.py [--quick] [--json FILE]

200 steps, 2 controls, and as many states as 2, 12 and 100 bodies in the plane have, dynamics block
diagonal as the model's are: by our dense form, by the form that knows of the blocks, and by
crocoddyl's DDP in C++ (one iteration, which is enough where dynamics are affine). All give the
optimal states and controls from a start; ours are float32, crocoddyl's double. One core; the ways
take turns. ``crocoddyl`` needs an environment of its own: ``make bench-peers``.
"""

import os

if hasattr(os, "sched_setaffinity"):  # Before JAX counts the cores.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import dataclasses
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measuring import arguments, report

from contactgraph.control import LQRProblem, solve_lqr
from contactgraph.control.lqr import dense_product
from contactgraph.control.rollout import block_product

HORIZON, CONTROLS = 200, 2
STATES = (8, 48, 400)
Run = Callable[[], Any]


def sample(states: int) -> tuple[LQRProblem, np.ndarray, np.ndarray]:
    """A problem with dense A, the blocks [H, n/2, 2, 2] of A, and a start; float64."""
    rng = np.random.default_rng(0)
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


def with_jax(problem: LQRProblem, start: np.ndarray, blocks: np.ndarray | None) -> Run:
    """Controls [H, U]; by the form that knows of ``blocks``, where they are given."""
    product = dense_product if blocks is None else block_product
    given = problem if blocks is None else dataclasses.replace(problem, A=blocks)
    placed = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (given, start))

    @jax.jit
    def solve(problem: LQRProblem, start: jax.Array) -> tuple[jax.Array, jax.Array]:
        policy, _ = solve_lqr(problem, product)

        def step(x: jax.Array, stage: tuple) -> tuple[jax.Array, tuple]:
            A, B, offset, policy = stage
            u = policy(x)
            rows = x if blocks is None else x.reshape(-1, 1, 2)
            moved = jnp.sum(A * rows, axis=-1).reshape(-1)
            return moved + jnp.sum(B * u, axis=-1) + offset, (x, u)

        return jax.lax.scan(step, start, (problem.A, problem.B, problem.offset, policy))[1]

    return lambda: jax.block_until_ready(solve(*placed))[1]


def with_crocoddyl(problem: LQRProblem, start: np.ndarray) -> tuple[str, Run] | None:
    """Its name and one run; None if it is not installed."""
    try:
        import crocoddyl
    except ImportError as missing:
        print(f"crocoddyl is left out: {missing} (make bench-peers installs it apart)")
        return None
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

    def run() -> np.ndarray:
        solver.solve(states, controls, 1, False, 0.0)
        return np.array(solver.us)

    return f"crocoddyl {version('crocoddyl')} DDP", run


def main() -> None:
    """Measure and say."""
    told = arguments("Time of one LQR solve, beside crocoddyl.")
    rows: list[dict[str, Any]] = []
    for states in STATES[:2] if told.quick else STATES:
        problem, blocks, start = sample(states)
        runs = {"dense": with_jax(problem, start, None), "blocks": with_jax(problem, start, blocks)}
        # 400 states take crocoddyl seconds, and only our two forms are compared there.
        if states < 100 and (peer := with_crocoddyl(problem, start)) is not None:
            runs[peer[0]] = peer[1]
        answers = {name: np.asarray(run()) for name, run in runs.items()}  # compiles, too
        seconds: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(3 if told.quick or states > 100 else 30):
            for name, run in runs.items():
                began = time.perf_counter()
                run()
                seconds[name].append(time.perf_counter() - began)
        scale = np.max(np.abs(answers["dense"]))
        rows += [
            {
                "states": states,
                "way": name,
                "median ms": 1e3 * float(np.median(seconds[name])),
                "fastest ms": 1e3 * min(seconds[name]),
                "times as long": float(np.median(np.divide(seconds[name], seconds["dense"]))),
                "controls differ by": f"{np.max(np.abs(answer - answers['dense'])) / scale:.0e}",
            }
            for name, answer in answers.items()
        ]
    report("lqr_solve", rows, told)


if __name__ == "__main__":
    main()
