"""The products of a Riccati step with its dynamics.

Notation, at one step (t is left out; a dash marks the step after)::

    x, u      state [n], control [U]
    x' = A x + B u + offset
    cost      x^T Q x + 2 q^T x + u^T R u + 2 r^T u, and at the end x^T Q x + 2 q^T x
    V(x)      x^T P x + 2 p^T x + constant, the least cost from here on
    w         P' offset + p'
    S         R + B^T P' B          curvature of the cost-to-go along u
    G         B^T P' A              how its slope along u moves with x
    g         r + B^T w             its slope along u at x = 0, u = 0
    K, k      -S^-1 G, -S^-1 g      the best control is u = K x + k
    P         Q + A^T P' A + G^T K
    p         q + A^T w + G^T k

With controls held at a limit, their rows of K are zero and the same two last lines hold, since
``K^T (S K + G) = 0`` and ``K^T (S k + g) = 0`` still do.

A `DynamicsOperator` makes the products with A and B. Three are here, each the fastest somewhere:

- `_SummedOperator`, for few states and any A: products written as sums, of which XLA makes few
  kernels inside a scan, while a call of a matrix product costs more than all the rest of a step.
- `_DenseOperator`, for many states and a dense A: two products of the size of A a step.
- `_BlockOperator`, for many states and the model's A: n^2 instead of n^3 operations.

A fourth, for batches of small problems, is in `contactgraph.control.lqr_adjoint`.

P must stay symmetric: rounding errors in its antisymmetric part grow with ``A^T (.) A``, which no
feedback holds. Reading a large P along its columns costs as much as the rest of a step, so the
large operators ask for it only after several steps.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.box_qp import SUMMED_SIZE


class LQRProblem(eqx.Module):
    """Dynamics and cost of all steps, in the notation at the head of this file."""

    A: Float[Array, "H ..."]
    """[H, n, n], or as the `DynamicsOperator` stores it."""
    B: Float[Array, "H n U"]
    offset: Float[Array, "H n"]
    Q: Float[Array, "H+1 n n"]
    R: Float[Array, "H U U"]
    q: Float[Array, "H+1 n"]
    r: Float[Array, "H U"]


class Products(eqx.Module):
    """Riccati intermediates: the cost-to-go of the step after, through one step's dynamics."""

    S: Float[Array, "U U *batch"]
    G: Float[Array, "U n *batch"]
    g: Float[Array, " U *batch"]
    slope: Float[Array, " n *batch"]
    """``A^T w``"""
    constant: Float[Array, "*batch"]
    """``offset^T (w + p')``"""
    P: Float[Array, "n n *batch"]
    """``P'`` or ``A^T P'``, as `DynamicsOperator.update` needs it."""


class DynamicsOperator(eqx.Module):
    """The products that the Riccati recursion needs of one step, however its A is stored."""

    symmetric_every: ClassVar[float] = 8
    """P is made symmetric after at most so many steps."""
    reads_ahead: ClassVar[bool] = False
    """See `contactgraph.control.lqr.scan_stages`."""

    @abc.abstractmethod
    def products(self, P: Array, p: Array, stage: LQRProblem) -> Products:
        """All products with P' and p' that the control's problem needs."""

    @abc.abstractmethod
    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> Array:
        """``Q + A^T P' A + G^T K``."""


Operator = Callable[[int], DynamicsOperator]
"""The operator for this many states."""


def dense_operator(size: int) -> DynamicsOperator:
    """For a dense A [n, n]."""
    return _DenseOperator() if size > SUMMED_SIZE else _SummedOperator(dense_product)


def block_operator(size: int) -> DynamicsOperator:
    """For block diagonal A [2, 2, n/2]: states are all positions, then all velocities.

    ``A[i, j]`` is the diagonal of the quadrant in row i and column j.
    """
    return _BlockOperator() if size > SUMMED_SIZE else _SummedOperator(block_product)


def dense_product(A: Float[Array, "n n"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for a dense A."""
    if A.shape[0] > SUMMED_SIZE:
        return A.T @ X
    return jnp.sum(A[:, :, None] * X[:, None, :], axis=0)


def block_product(A: Float[Array, "2 2 m"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for block diagonal A, ``n = 2m``."""
    rows = X.reshape(2, A.shape[-1], -1)
    return (A[0, :, :, None] * rows[0] + A[1, :, :, None] * rows[1]).reshape(X.shape)


class _SummedOperator(DynamicsOperator):
    """Sums of products instead of matrix products.

    In a scan of small steps the number of operations costs, not their size: products with the same
    matrix are taken together.
    """

    transpose_product: Callable[[Array, Array], Array] = eqx.field(static=True)
    symmetric_every: ClassVar[float] = 1

    def products(self, P: Array, p: Array, stage: LQRProblem) -> Products:
        size = P.shape[0]
        X = jnp.concatenate([stage.B, stage.offset[:, None]], axis=1)
        onward = jnp.sum(P[:, :, None] * X, axis=1)
        PB, w = onward[:, :-1], onward[:, -1] + p
        pulled = self.transpose_product(stage.A, jnp.concatenate([P, PB, w[:, None]], axis=1))
        return _products(stage, p, PB, w, pulled[:, size:].T, pulled[:, :size])

    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> Array:
        P = stage.Q + self.transpose_product(stage.A, now.P.T)
        return P + jnp.sum(now.G[:, :, None] * K[:, None, :], axis=0)


class _DenseOperator(DynamicsOperator):
    """Thin products from the left: P is symmetric, and its rows lie in one piece."""

    def products(self, P: Array, p: Array, stage: LQRProblem) -> Products:
        onward = (jnp.concatenate([stage.B.T, stage.offset[None]]) @ P).at[-1].add(p)
        return _products(stage, p, onward[:-1].T, onward[-1], onward @ stage.A, P)

    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> Array:
        return stage.Q + stage.A.T @ (now.P @ stage.A) + _outer(now.G, K)


class _BlockOperator(DynamicsOperator):
    """As `_DenseOperator`; A's quadrants are diagonal, so that products with A are elementwise."""

    def products(self, P: Array, p: Array, stage: LQRProblem) -> Products:
        onward = (jnp.concatenate([stage.B.T, stage.offset[None]]) @ P).at[-1].add(p).T
        pulled = block_product(stage.A, onward).T
        return _products(stage, p, onward[:, :-1], onward[:, -1], pulled, P)

    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> Array:
        # XLA does not fuse across a conditional's bounds, which is this one's only purpose: within
        # it, neither this step's inputs are read out of the arrays of all steps nor is P written
        # over, either of which keeps XLA from vectorising. It makes the step three times faster.
        count = stage.A.shape[-1]
        arguments = now.P, stage.A, now.G.reshape(-1, 2, count), K.reshape(-1, 2, count)
        moved = jax.lax.cond(step >= 0, self._moved, self._moved, *arguments)
        return stage.Q + moved

    def _moved(
        self, P: Array, A: Array, G: Float[Array, "U 2 m"], K: Float[Array, "U 2 m"]
    ) -> Float[Array, "n n"]:
        """``A^T P A + G^T K`` in two halves, P's columns of positions and of velocities: XLA
        vectorises along the rows of such planes."""
        count = A.shape[-1]
        planes = P.reshape(2, count, 2, count)

        def half(j: int) -> Float[Array, "n m"]:
            rows = planes[:, :, 0] * A[0, j] + planes[:, :, 1] * A[1, j]
            moved = A[0][:, :, None] * rows[0] + A[1][:, :, None] * rows[1]
            return (moved + _outer(G, K[:, j])).reshape(-1, count)

        return jnp.concatenate([half(0), half(1)], axis=1)


def _outer(G: Float[Array, "U ..."], K: Float[Array, "U ..."]) -> Float[Array, "..."]:
    """``G^T K``, written out: U is small, and sums over an axis are not vectorised here."""
    G = G.reshape(*G.shape, *[1] * (K.ndim - 1))
    total = G[0] * K[0]
    for row in range(1, G.shape[0]):
        total = total + G[row] * K[row]
    return total


def _products(
    stage: LQRProblem, p: Array, PB: Array, w: Array, pulled: Float[Array, "U+1 n"], P: Array
) -> Products:
    """``pulled`` is the transpose of ``A^T [P' B, w]``."""
    slopes = dense_product(stage.B, jnp.concatenate([PB, w[:, None]], axis=1))
    S, g = stage.R + slopes[:, :-1], stage.r + slopes[:, -1]
    return Products(S, pulled[:-1], g, pulled[-1], stage.offset @ (w + p), P)
