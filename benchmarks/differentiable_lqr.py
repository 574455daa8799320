"""Time of an optimal trajectory and its gradients, compared with other methods.

Usage: python benchmarks/differentiable_lqr.py [--quick] [--json FILE]

One forward pass and one backward pass, for given slopes of the loss, through 200 steps of 40
problems with 8 states and 2 controls, on one core: by the adjoint rule of `lqr_trajectory` (the
batch in the last axis, and in the first), by autodiff through the same Riccati scan, and by
mpc.pytorch (package ``mpc``) with its own implicit rule and one LQR step.
Gradients are with respect to dynamics, cost and start; trajectories and gradients are compared.
"""

import one_core  # noqa: F401, I001  before JAX
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from lqr_sample import MPCTorch, through_the_scan

from measuring import Missing, Method, arguments, compare, report
from contactgraph.control import LQRProblem, LQRTrajectory, lqr_trajectory

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


def with_jax(
    name: str, solver: Callable, axis: int, data: tuple, answer: Callable[[Answer], Answer]
) -> Method:
    """Our solver, with the batch in this axis of every array."""
    placed = jax.tree.map(lambda leaf: jnp.asarray(np.moveaxis(leaf, 0, axis)), data)

    @jax.jit
    def both(problem: LQRProblem, start: jax.Array, slopes: LQRTrajectory) -> Answer:
        batched = jax.vmap(solver, in_axes=axis, out_axes=axis)
        trajectory, pull = jax.vjp(batched, problem, start)
        return trajectory, pull(slopes)

    return Method(name, lambda: jax.block_until_ready(both(*placed)), answer)


def with_mpc(data: tuple) -> Method | Missing:
    """mpc.pytorch."""
    problem, start, slopes = data
    try:
        peer = MPCTorch(problem, start)
    except ImportError as missing:
        return Missing("mpc", str(missing))
    import torch

    leaves = [peer.C, peer.c, peer.F, peer.f, peer.start]
    for leaf in leaves:
        leaf.requires_grad_()
    along = [
        torch.tensor(np.ascontiguousarray(slope.swapaxes(0, 1)))
        for slope in (slopes.states, np.pad(slopes.controls, ((0, 0), (0, 1), (0, 0))))
    ]

    def run() -> Any:
        states, controls = peer.solve()
        return states, controls, torch.autograd.grad([states, controls], leaves, along)

    def answer(returned: Any) -> Answer:
        n = STATES
        states, controls, dC, dc, dF, df = (
            array.detach().numpy().swapaxes(0, 1) for array in (*returned[:2], *returned[2][:4])
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
        return LQRTrajectory(states, controls[:, :-1]), (gradients, returned[2][4].numpy())

    return Method(peer.name, run, answer)


def symmetric(answer: Answer) -> Answer:
    """Autodiff distinguishes the two halves of Q and R; the adjoint rule does not."""
    return eqx.tree_at(
        lambda both: (both[1][0].Q, both[1][0].R),
        answer,
        replace_fn=lambda slope: 0.5 * (slope + slope.swapaxes(-1, -2)),
    )


def batch_first(answer: Answer) -> Answer:
    """Moves the batch from the last axis to the first."""
    return jax.tree.map(lambda leaf: np.moveaxis(leaf, -1, 0), answer)


def main() -> None:
    """Measure and print."""
    options = arguments("Time of a differentiable LQR, forwards and backwards.")
    data = sample()
    ours = with_jax("adjoint rule", lqr_trajectory, -1, data, batch_first)
    others = [
        with_jax("the same, batch first", lqr_trajectory, 0, data, lambda given: given),
        with_jax("autodiff of the scan", through_the_scan, 0, data, symmetric),
        with_mpc(data),
    ]
    what = f"LQR and gradient, T = {HORIZON}, U = {CONTROLS}, n = {STATES}, batch {BATCH}"
    report("differentiable_lqr", compare(what, ours, others, options.quick), options)


if __name__ == "__main__":
    main()
