"""Time to solve one LQR problem, compared with crocoddyl's differential dynamic programming.

Usage: python benchmarks/lqr_solve.py [--quick] [--json FILE]

200 steps, 2 controls, and as many states as 2, 12 and 100 bodies in the plane have, dynamics block
diagonal as the model's are: by our dense form, by crocoddyl's DDP in C++, and by our block
form, which is compared with the dense one. All give the optimal states and controls
from a start; ours are float32, crocoddyl's double. One core.
"""

import one_core  # noqa: F401, I001  before JAX
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from lqr_sample import sample, with_crocoddyl

from measuring import Method, arguments, compare, report
from contactgraph.control import LQRProblem, solve_lqr
from contactgraph.control.riccati import Operator, block_operator, dense_operator

STATES = (8, 48, 400)
MOST_FOR_PEERS = 100
"""400 states take crocoddyl seconds; there only our two forms are compared."""


def dense(problem: LQRProblem, start: np.ndarray) -> Method:
    """Controls [H, U]; A is a matrix."""
    few = len(start) <= 16

    def moved(A: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.sum(A * x, axis=-1) if few else A @ x

    return _ours("our dense form", problem, start, dense_operator, moved)


def in_blocks(problem: LQRProblem, start: np.ndarray, blocks: np.ndarray) -> Method:
    """The same; all positions before all velocities, A its blocks."""
    order = np.arange(len(start)).reshape(-1, 2).T.reshape(-1)
    given = LQRProblem(
        A=np.moveaxis(blocks, 1, -1),
        B=problem.B[:, order],
        offset=problem.offset[:, order],
        Q=problem.Q[:, order[:, None], order],
        R=problem.R,
        q=problem.q[:, order],
        r=problem.r,
    )

    def moved(A: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.sum(A * x.reshape(2, -1), axis=1).reshape(-1)

    return _ours("our block form", given, start[order], block_operator, moved)


def _ours(
    name: str, problem: LQRProblem, start: np.ndarray, operator: Operator, moved: Callable
) -> Method:
    placed = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (problem, start))

    @jax.jit
    def solve(problem: LQRProblem, start: jax.Array) -> tuple[jax.Array, jax.Array]:
        policy, _ = solve_lqr(problem, operator)

        def step(x: jax.Array, stage: tuple) -> tuple[jax.Array, tuple]:
            A, B, offset, policy = stage
            u = policy(x)
            return moved(A, x) + jnp.sum(B * u, axis=-1) + offset, (x, u)

        return jax.lax.scan(step, start, (problem.A, problem.B, problem.offset, policy))[1]

    return Method(name, lambda: jax.block_until_ready(solve(*placed))[1])


def main() -> None:
    """Measure and print."""
    options = arguments("Time of one LQR solve, beside crocoddyl.")
    rows = []
    for states in STATES[:2] if options.quick else STATES:
        problem, blocks, start = sample(states)
        without = dense(problem, start)
        what = f"LQR, T = 200, U = 2, n = {states}"
        if states < MOST_FOR_PEERS:
            peers = [with_crocoddyl(problem, start)]
            rows += compare(f"{what}, dense", without, peers, options.quick)
        rows += compare(
            f"{what}, blocks", in_blocks(problem, start, blocks), [without], options.quick
        )
    report("lqr_solve", rows, options)


if __name__ == "__main__":
    main()
