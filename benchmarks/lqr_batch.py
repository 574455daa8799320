"""Time to solve a batch of 64 LQR problems, compared with mpc.pytorch.

Usage: python benchmarks/lqr_batch.py [--quick] [--json FILE]

200 steps, 2 controls, 8 and 48 states, float32, one core: optimal states and controls from a start
each. Ours are `lqr_trajectory` with the batch in the last axis (8 states), and our dense solve of
eight problems at once, one eight after the other (48 states: all at once, they would not fit the
caches).
"""

import one_core  # noqa: F401, I001  before JAX

import jax
import jax.numpy as jnp
import numpy as np
from lqr_sample import MPCTorch, sample

from measuring import Missing, Method, arguments, compare, report
from contactgraph.control import LQRProblem, lqr_trajectory, solve_lqr

BATCH, FEW = 64, 8
Problems = tuple[LQRProblem, np.ndarray]
"""With a leading axis, the batch."""


def problems(states: int) -> Problems:
    """The batch; float64."""
    samples = [(problem, start) for problem, _, start in (sample(states, i) for i in range(BATCH))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *samples)


def side_by_side(given: Problems) -> Method:
    """All at once, the batch last."""
    problem, start = jax.tree.map(
        lambda leaf: jnp.asarray(np.moveaxis(leaf, 0, -1), jnp.float32), given
    )
    solve = jax.jit(jax.vmap(lqr_trajectory, in_axes=-1, out_axes=-1))
    return Method(
        "ours",
        lambda: jax.block_until_ready(solve(problem, start)),
        lambda trajectory: np.moveaxis(trajectory.controls, -1, 0),
    )


def few_at_a_time(given: Problems) -> Method:
    """Eight at once; each call solves the next eight."""

    def one(problem: LQRProblem, start: jax.Array) -> jax.Array:
        policy, _ = solve_lqr(problem)

        def step(x: jax.Array, stage: tuple) -> tuple[jax.Array, jax.Array]:
            A, B, offset, policy = stage
            u = policy(x)
            return A @ x + B @ u + offset, u

        stages = problem.A, problem.B, problem.offset, policy
        return jax.lax.scan(step, start, stages)[1]

    solve = jax.jit(jax.vmap(one))
    leaves, structure = jax.tree.flatten(given)
    split = [np.split(leaf.astype(np.float32), BATCH // FEW) for leaf in leaves]
    parts = [
        jax.tree.unflatten(structure, map(jnp.asarray, part)) for part in zip(*split, strict=True)
    ]
    return Method(
        "ours",
        lambda: jax.block_until_ready([solve(*part) for part in parts]),
        lambda controls: np.concatenate(controls),
    )


def with_mpc(given: Problems) -> Method | Missing:
    """mpc.pytorch; returns the controls."""
    try:
        peer = MPCTorch(*given)
    except ImportError as missing:
        return Missing("mpc", str(missing))
    return Method(peer.name, peer.solve, lambda both: both[1].numpy().swapaxes(0, 1)[:, :-1])


def main() -> None:
    """Measure and print."""
    options = arguments("Time of a batch of LQR solves, beside mpc.pytorch.")
    rows = []
    for states, way in ((8, side_by_side), (48, few_at_a_time)):
        given = problems(states)
        what = f"{BATCH} LQR problems, T = 200, U = 2, n = {states}"
        rows += compare(what, way(given), [with_mpc(given)], options.quick)
    report("lqr_batch", rows, options)


if __name__ == "__main__":
    main()
