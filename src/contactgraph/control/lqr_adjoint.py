"""The optimal trajectory of an affine LQR problem, and its derivatives by one adjoint solve.

The notation is that of `contactgraph.control.riccati`. The optimal ``x, u`` and the costates ``l``
satisfy the KKT conditions (a dash marks the step after)::

    Q x + q + A^T l'    =  l        at the end  Q x + q = l
    R u + r + B^T l'    =  0
    A x + B u + offset  =  x'       x_0 = start

`factor_kkt` computes the part that depends on ``A, B, Q, R`` alone: ``S``, ``K``, ``P`` and
``M = A + B K``. Then `solve_kkt` for any ``q, r, offset, start`` is two scans of one vector::

    backwards   p  = q + K^T r + M^T (P' offset + p')        k = -S^-1 (r + B^T (P' offset + p'))
    forwards    x' = M x + B k + offset                      u = K x + k,  l' = P' x' + p'

The KKT matrix is symmetric. The derivatives of a loss ``L(x, u)`` therefore come from solving once
more, with ``dL/dx, dL/du`` in the place of ``q, r`` and with zero ``offset`` and ``start`` (Amos et
al. 2018, "Differentiable MPC for End-to-end Planning and Control"). With the solution
``dx, du, dl``::

    dL/dq, dL/dr       dx, du
    dL/dQ, dL/dR       (dx x^T + x dx^T) / 2, (du u^T + u du^T) / 2
    dL/dA, dL/dB       dl' x^T + l' dx^T, dl' u^T + l' du^T
    dL/doffset         dl'
    dL/dstart          dl_0

`_BatchLastOperator` makes the Riccati recursion fast on a CPU for batches of small problems:

- A batch is the *last* axis of every array, and a product is a sum over its inner index of
  elementwise products, which XLA makes one vectorised kernel along the batch. The batched small
  products of `jnp.matmul` are five times slower.
- The loops read ahead (`scan_stages`).
- A product whose result enters another product on the left, entry by entry (`_inner`), is used too
  often for XLA to compute it again at each use.

Its P is that of Joseph's form, ``Q + K^T R K + M^T P' M``, which damps rounding errors, an
asymmetry of P among them.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from contactgraph.control.box_qp import AffinePolicy, solve_small
from contactgraph.control.lqr import read_stage, riccati_pass, scan_stages
from contactgraph.control.riccati import DynamicsOperator, LQRProblem, Products


class KKTFactors(eqx.Module):
    """The part of all solutions of one problem; P is that of the step after."""

    B: Float[Array, "H n U *batch"]
    P: Float[Array, "H n n *batch"]
    S: Float[Array, "H U U *batch"]
    K: Float[Array, "H U n *batch"]
    M: Float[Array, "H n n *batch"]
    """``A + B K``, the closed-loop dynamics."""


class KKTSolution(eqx.Module):
    """A solution of the optimality conditions."""

    states: Float[Array, "H+1 n *batch"]
    controls: Float[Array, "H U *batch"]
    costates: Float[Array, "H n *batch"]
    """Of the step after: multipliers of the dynamics."""
    first_slope: Float[Array, " n *batch"]
    """p of the first step; its costate is ``P x + p``."""


def factor_kkt(A: Array, B: Array, Q: Array, R: Array) -> KKTFactors:
    """The Riccati pass. ``A`` [H, n, n], ``B`` [H, n, U], ``Q`` [H+1, n, n], ``R`` [H, U, U].

    Each may have a last axis more, the batch; one of length 1 is shared.
    """
    # Linear terms do not enter the factors: of all that depends on them, XLA computes nothing.
    problem = LQRProblem(
        A, B, jnp.zeros_like(B[:, :, 0]), Q, R, jnp.zeros_like(Q[:, :, 0]), jnp.zeros_like(R[:, 0])
    )

    def choose(now: Products, step: Array) -> tuple[AffinePolicy, tuple[Array, Array]]:
        K = -solve_small(now.S, now.G)
        return AffinePolicy(K, jnp.zeros_like(now.g)), (now.S, K)

    batch = jnp.broadcast_shapes(*(leaf.shape[3:] for leaf in (A, B, Q, R)))
    final = jnp.broadcast_to(Q[-1], (*Q.shape[1:3], *batch))
    value = final, jnp.zeros_like(final[0])
    (P, _), (S, K) = riccati_pass(choose, value, problem, _BatchLastOperator())
    return KKTFactors(B, P[1:], S, K, jax.vmap(_closed_loop)(A, B, K))


class _BatchLastOperator(DynamicsOperator):
    """Every array has the batch as its last axis."""

    symmetric_every: ClassVar[float] = math.inf
    reads_ahead: ClassVar[bool] = True

    def products(self, P: Array, p: Array, stage: LQRProblem) -> Products:
        PB, w = _product(P, stage.B), _step_times(P, stage.offset) + p
        return Products(
            S=stage.R + _inner((PB, stage.B)),
            G=_inner((PB, stage.A)),
            g=stage.r + _step_transpose_times(stage.B, w),
            slope=_step_transpose_times(stage.A, w),
            constant=jnp.sum(stage.offset * (w + p), axis=0),
            P=P,
        )

    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> Array:
        M = _closed_loop(stage.A, stage.B, K)
        return stage.Q + _inner((_product(now.P, M), M), (_product(stage.R, K), K))


def _closed_loop(A: Array, B: Array, K: Array) -> Array:
    return A + _product(B, K)


def solve_kkt(
    factors: KKTFactors, q: Array, r: Array, offset: Array | None, start: Array
) -> KKTSolution:
    """The solution for these linear terms. Shapes as in `LQRProblem`, then the batch.

    An ``offset`` of None is zero.
    """
    B, P, K, M = factors.B, factors.P, factors.K, factors.M
    added = q[:-1] + _transpose_times(K, r)
    slope = r
    if offset is not None:
        shifted = _times(P, offset)
        added = added + _transpose_times(M, shifted)
        slope = slope + _transpose_times(B, shifted)
    p, first_slope = _recursion(_step_transpose_times, M, added, q[-1], reverse=True)
    slope = slope + _transpose_times(B, p)
    k = -jax.vmap(solve_small)(factors.S, slope[:, :, None])[:, :, 0]
    moved = _times(B, k) if offset is None else _times(B, k) + offset
    x, last = _recursion(_step_times, M, moved, start, reverse=False)
    after = jnp.concatenate([x[1:], last[None]])
    return KKTSolution(
        states=jnp.concatenate([x, last[None]]),
        controls=_times(K, x) + k,
        costates=_times(P, after) + p,
        first_slope=first_slope,
    )


def _recursion(
    times: Callable, M: Array, added: Array, first: Array, reverse: bool
) -> tuple[Array, Array]:
    """``y <- M y + added``: the y that enters each step, and the last."""
    batch = jnp.broadcast_shapes(M.shape[3:], added.shape[2:], first.shape[1:])
    first = jnp.broadcast_to(first, (first.shape[0], *batch))

    def step(y: Array, stage: tuple[Array, Array], index: Array) -> tuple[Array, Array]:
        return times(stage[0], y) + stage[1], y

    read = functools.partial(read_stage, (M, added))
    last, entering = scan_stages(step, first, read, jnp.arange(len(M)), reverse, reads_ahead=True)
    return entering, last


def _total(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def _product(X: Float[Array, "i k *b"], Y: Float[Array, "k j *b"]) -> Float[Array, "i j *b"]:
    return _total(X[:, k, None] * Y[None, k] for k in range(X.shape[1]))


def _inner(*pairs: tuple[Float[Array, "k i *b"], Float[Array, "k j *b"]]) -> Float[Array, "i j *b"]:
    """The sum of ``X^T Y`` over pairs: one kernel, X read entry by entry."""
    rows = range(pairs[0][0].shape[1])
    return jnp.stack(
        [_total(X[k, i] * Y[k] for X, Y in pairs for k in range(X.shape[0])) for i in rows]
    )


def _step_times(X: Float[Array, "i k *b"], y: Float[Array, " k *b"]) -> Float[Array, " i *b"]:
    return _total(X[:, k] * y[k] for k in range(X.shape[1]))


def _step_transpose_times(
    X: Float[Array, "k i *b"], y: Float[Array, " k *b"]
) -> Float[Array, " i *b"]:
    return _total(X[k] * y[k] for k in range(X.shape[0]))


_times = jax.vmap(_step_times)
_transpose_times = jax.vmap(_step_transpose_times)


class LQRTrajectory(eqx.Module):
    """An optimally controlled system."""

    states: Float[Array, "H+1 n *batch"]
    """m and m/s; the first is the start."""
    controls: Float[Array, "H U *batch"]
    """N"""


def lqr_trajectory(problem: LQRProblem, start: Float[Array, " n"]) -> LQRTrajectory:
    """The states and controls that minimise the problem's cost from ``start`` [n] (m and m/s).

    ``minimise  sum_{t=0..H} (x_t^T Q_t x_t + 2 q_t^T x_t)
    + sum_{t=0..H-1} (u_t^T R_t u_t + 2 r_t^T u_t)``
    with ``x_{t+1} = A_t x_t + B_t u_t + offset_t`` and ``x_0 = start``.

    Differentiable, once and in reverse mode (`jax.grad`, `jax.vjp`), with respect to every leaf of
    the problem and the start, by the rule at the head of this file. ``Q`` and ``R`` must be
    symmetric, and so are their derivatives: those along symmetric changes. Forward mode
    (`jax.jvp`) is not defined and raises JAX's own error.

    One problem with a dense ``A`` [H, n, n]; for a batch use `jax.vmap`, in which any leaf may be
    shared. A batch kept in the last axis of every array (``in_axes=-1, out_axes=-1``) is fastest:
    it needs no transposition. Some hundreds of problems at a time fit a processor's caches; take
    thousands in parts, with `jax.lax.map`.
    """
    return _trajectory(problem, start)


def _batch_last(function: Callable) -> Callable:
    """Under `jax.vmap`, call the function once with the batch as the last axis of every array.

    An array without a batch gets a last axis of length 1 there.
    """
    batched = custom_vmap(function)

    def with_batch(size: int, is_batched: list, *arguments: Any) -> tuple[Any, Any]:
        def last(leaf: Array, has_batch: bool) -> Array:
            return jnp.moveaxis(leaf, 0, -1) if has_batch else leaf[..., None]

        def first(leaf: Array) -> Array:
            return jnp.moveaxis(jnp.broadcast_to(leaf, (*leaf.shape[:-1], size)), -1, 0)

        answer = function(*jax.tree.map(last, arguments, tuple(is_batched)))
        return jax.tree.map(first, answer), jax.tree.map(lambda _: True, answer)

    batched.def_vmap(with_batch)
    return batched


@_batch_last
def _forward(
    problem: LQRProblem, start: Array
) -> tuple[LQRTrajectory, tuple[KKTFactors, KKTSolution]]:
    factors = factor_kkt(problem.A, problem.B, problem.Q, problem.R)
    solution = solve_kkt(factors, problem.q, problem.r, problem.offset, start)
    return LQRTrajectory(solution.states, solution.controls), (factors, solution)


@_batch_last
def _backward(
    kept: tuple[KKTFactors, KKTSolution], slope: LQRTrajectory
) -> tuple[LQRProblem, Array]:
    factors, solution = kept
    rest = jnp.zeros_like(solution.states[0])
    adjoint = solve_kkt(factors, slope.states, slope.controls, None, rest)
    x, u, after = solution.states[:-1], solution.controls, solution.costates
    dx, du, dafter = adjoint.states[:-1], adjoint.controls, adjoint.costates
    problem = LQRProblem(
        A=_outer(dafter, x) + _outer(after, dx),
        B=_outer(dafter, u) + _outer(after, du),
        offset=dafter,
        Q=_symmetric_outer(adjoint.states, solution.states),
        R=_symmetric_outer(du, u),
        q=adjoint.states,
        r=du,
    )
    # The adjoint starts at rest, so its first costate is its first slope.
    return problem, adjoint.first_slope


@jax.custom_vjp
def _trajectory(problem: LQRProblem, start: Array) -> LQRTrajectory:
    return _forward(problem, start)[0]


_trajectory.defvjp(_forward, _backward)


def _outer(left: Float[Array, "T i *b"], right: Float[Array, "T j *b"]) -> Array:
    return left[:, :, None] * right[:, None]


def _symmetric_outer(left: Float[Array, "T i *b"], right: Float[Array, "T i *b"]) -> Array:
    return 0.5 * (_outer(left, right) + _outer(right, left))
