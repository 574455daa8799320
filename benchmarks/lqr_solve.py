"""How long one LQR problem takes to solve, beside crocoddyl's differential dynamic programming.

Usage: python benchmarks/lqr_solve.py [--quick] [--json FILE]

200 steps, 2 controls, and as many states as 2, 12 and 100 bodies in the plane have, dynamics block
diagonal as the model's are: by our dense form, by crocoddyl's DDP in C++, and by our form that
knows of the blocks, which is compared with the dense one. All give the optimal states and controls
from a start; ours are float32, crocoddyl's double. One core.
"""

import one_core  # noqa: F401, I001  before JAX
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from comparing import Way, compared
from lqr_sample import sample, with_crocoddyl
from measuring import arguments, report

from contactgraph.control import LQRProblem, solve_lqr
from contactgraph.control.lqr import dense_product
from contactgraph.control.rollout import block_product

STATES = (8, 48, 400)
MOST_FOR_PEERS = 100
"""400 states take crocoddyl seconds; there only our two forms are compared."""


def ours(problem: LQRProblem, start: np.ndarray, blocks: np.ndarray | None) -> Way:
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

    name = "our dense form" if blocks is None else "our block form"
    return Way(name, lambda: jax.block_until_ready(solve(*placed))[1])


def main() -> None:
    """Measure and say."""
    told = arguments("Time of one LQR solve, beside crocoddyl.")
    rows = []
    for states in STATES[:2] if told.quick else STATES:
        problem, blocks, start = sample(states)
        dense = ours(problem, start, None)
        what = f"LQR, T = 200, U = 2, n = {states}"
        if states < MOST_FOR_PEERS:
            peers = [with_crocoddyl(problem, start)]
            rows += compared(f"{what}, dense", dense, peers, told.quick)
        rows += compared(f"{what}, blocks", ours(problem, start, blocks), [dense], told.quick)
    report("lqr_solve", rows, told)


if __name__ == "__main__":
    main()
