"""The optimality conditions of an affine LQR problem, factorised once and solved many times.

The notation is that of `contactgraph.control.lqr`. The optimal ``x, u`` and the costates ``l``
satisfy (a dash marks the step after)::

    Q x + q + A^T l'    =  l        at the end  Q x + q = l
    R u + r + B^T l'    =  0
    A x + B u + offset  =  x'       x_0 = start

`LQRFactors` holds what depends on ``A, B, Q, R`` alone::

    S  = R + B^T P' B        K = -S^-1 B^T P' A        M = A + B K
    P  = Q + K^T R K + M^T P' M

(the last one, Joseph's form, damps rounding errors, an asymmetry of P among them), so that a
solution for any ``q, r, offset, start`` is two scans of one vector::

    backwards   p  = q + K^T r + M^T (P' offset + p')        k = -S^-1 (r + B^T (P' offset + p'))
    forwards    x' = M x + B k + offset                      u = K x + k,  l' = P' x' + p'

Written for speed on a CPU, where it is the number and the form of XLA's kernels that cost:

- A batch is the *last* axis of every array, and a product is a sum over its inner index of
  elementwise products, which XLA makes one vectorised kernel along the batch. The batched small
  products of `jnp.matmul` are five times slower. No batch axis at all is fine, too.
- A loop carries its *next* inputs (`_values`). XLA would otherwise fuse the read of a step's
  inputs into each kernel that uses them, and such a kernel is not vectorised.
- A product whose result enters another product on the left, entry by entry (`_inner`), is used too
  often for XLA to compute it anew at each use.
"""

import functools
import operator
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.control_step import solve_small


class LQRFactors(eqx.Module):
    """What all solutions of one problem share; P is that of the step after."""

    B: Float[Array, "H n U *batch"]
    P: Float[Array, "H n n *batch"]
    S: Float[Array, "H U U *batch"]
    K: Float[Array, "H U n *batch"]
    M: Float[Array, "H n n *batch"]
    """``A + B K``: how the controlled state moves."""


class LQRSolution(eqx.Module):
    """A solution of the optimality conditions."""

    states: Float[Array, "H+1 n *batch"]
    controls: Float[Array, "H U *batch"]
    costates: Float[Array, "H n *batch"]
    """Of the step after: multipliers of the dynamics."""
    first_slope: Float[Array, " n *batch"]
    """p of the first step; its costate is ``P x + p``."""


def factorised(A: Array, B: Array, Q: Array, R: Array) -> LQRFactors:
    """The Riccati pass. ``A`` [H, n, n], ``B`` [H, n, U], ``Q`` [H+1, n, n], ``R`` [H, U, U].

    Each may have a last axis more, the batch; one of length 1 is shared.
    """

    def before(P: Array, stage: tuple) -> Array:
        A, B, Q, R = stage
        _, K, M = _gain(P, A, B, R)
        return Q + _inner((_product(P, M), M), (_product(R, K), K))

    batch = jnp.broadcast_shapes(*(leaf.shape[3:] for leaf in (A, B, Q, R)))
    final = jnp.broadcast_to(Q[-1], (*Q.shape[1:3], *batch))
    P, _ = _values(before, final, (A, B, Q[:-1], R), reverse=True)
    # All steps at once, which is faster than to store them from within the loop.
    S, K, M = jax.vmap(_gain)(P, A, B, R)
    return LQRFactors(B, P, S, K, M)


def solved(
    factors: LQRFactors, q: Array, r: Array, offset: Array | None, start: Array
) -> LQRSolution:
    """The solution for these linear terms. Shapes as in `LQRProblem`, then the batch.

    An ``offset`` of None is zero.
    """
    B, P, K, M = factors.B, factors.P, factors.K, factors.M
    added = q[:-1] + _transpose_times(K, r)
    slope = r
    if offset is not None:
        pushed = _times(P, offset)
        added = added + _transpose_times(M, pushed)
        slope = slope + _transpose_times(B, pushed)
    p, first_slope = _recursion(_step_transpose_times, M, added, q[-1], reverse=True)
    slope = slope + _transpose_times(B, p)
    k = -jax.vmap(solve_small)(factors.S, slope[:, :, None])[:, :, 0]
    moved = _times(B, k) if offset is None else _times(B, k) + offset
    x, last = _recursion(_step_times, M, moved, start, reverse=False)
    after = jnp.concatenate([x[1:], last[None]])
    return LQRSolution(
        states=jnp.concatenate([x, last[None]]),
        controls=_times(K, x) + k,
        costates=_times(P, after) + p,
        first_slope=first_slope,
    )


def _gain(P: Array, A: Array, B: Array, R: Array) -> tuple[Array, Array, Array]:
    """S, K and M of one step."""
    PB = _product(P, B)
    S = R + _inner((PB, B))
    K = -solve_small(S, _inner((PB, A)))
    return S, K, A + _product(B, K)


def _recursion(
    times: Callable, M: Array, added: Array, first: Array, reverse: bool
) -> tuple[Array, Array]:
    """``y <- M y + added``; see `_values`."""
    batch = jnp.broadcast_shapes(M.shape[3:], added.shape[2:], first.shape[1:])
    first = jnp.broadcast_to(first, (first.shape[0], *batch))
    return _values(lambda y, stage: times(stage[0], y) + stage[1], first, (M, added), reverse)


def _values(
    step: Callable[[Array, tuple], Array], first: Array, inputs: tuple, reverse: bool
) -> tuple[Array, Array]:
    """``value <- step(value, inputs of a time)``: the value that enters each time, and the last."""
    horizon = inputs[0].shape[0]

    def at(t: Array | int) -> tuple:
        return jax.tree.map(
            lambda leaf: jax.lax.dynamic_index_in_dim(leaf, t, keepdims=False), inputs
        )

    def body(carry: tuple, t: Array) -> tuple[tuple, Array]:
        value, now = carry
        # Past the end some valid stage is read, and not used.
        return (step(value, now), at(t - 1 if reverse else t + 1)), value

    start = (first, at(horizon - 1 if reverse else 0))
    (last, _), entering = jax.lax.scan(body, start, jnp.arange(horizon), reverse=reverse)
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
