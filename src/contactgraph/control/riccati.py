"""The products of a Riccati step with its dynamics, in the notation of `contactgraph.control.lqr`.

Three operators give the same products, each the fastest somewhere:

- `SummedOperator`, for few states and any A: products written as sums, of which XLA makes few
  kernels inside a scan, while a call of a matrix product costs more than all the rest of a step.
- `DenseOperator`, for many states and a dense A: two products of the size of A a step.
- `BlockOperator`, for many states and the model's A: n^2 instead of n^3 operations.

P must stay symmetric: rounding errors in its antisymmetric part grow with ``A^T (.) A``, which no
feedback holds. Reading a large P along its columns costs as much as the rest of a step, so the
large operators ask for it only after several steps.
"""

from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_SUMMED_SIZE = 16
_LARGE_EVERY = 8


class Products(eqx.Module):
    """Riccati intermediates: the cost-to-go of the step after, through one step's dynamics."""

    PB: Float[Array, "n U"]
    """``P' B``"""
    w: Float[Array, " n"]
    """``P' offset + p'``"""
    G: Float[Array, "U n"]
    """``B^T P' A``"""
    slope: Float[Array, " n"]
    """``A^T w``"""
    P: Float[Array, "n n"]
    """``P'``, or ``A^T P'``, as `DynamicsOperator.update` needs it."""


class DynamicsOperator(Protocol):
    """The products that the Riccati recursion needs of one step's A, however that is stored."""

    @property
    def symmetric_every(self) -> int:
        """P is made symmetric after at most so many steps."""
        ...

    def products(
        self, P: Float[Array, "n n"], p: Array, A: Array, B: Array, offset: Array
    ) -> Products:
        """All products with P' and A that the control's problem needs."""
        ...

    def update(
        self, products: Products, A: Array, Q: Float[Array, "n n"], K: Array, step: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """``Q + A^T P' A + G^T K``."""
        ...


Operator = Callable[[int], DynamicsOperator]
"""The operator for this many states."""


def dense_operator(size: int) -> DynamicsOperator:
    """For a dense A [n, n]."""
    return DenseOperator() if size > _SUMMED_SIZE else SummedOperator(dense_product)


def block_operator(size: int) -> DynamicsOperator:
    """For block diagonal A [2, 2, n/2]: states are all positions, then all velocities.

    ``A[i, j]`` is the diagonal of the quadrant in row i and column j.
    """
    return BlockOperator() if size > _SUMMED_SIZE else SummedOperator(block_product)


def dense_product(A: Float[Array, "n n"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for a dense A."""
    if A.shape[0] > _SUMMED_SIZE:
        return A.T @ X
    return jnp.sum(A[:, :, None] * X[:, None, :], axis=0)


def block_product(A: Float[Array, "2 2 m"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for block diagonal A, ``n = 2m``."""
    rows = X.reshape(2, A.shape[-1], -1)
    return (A[0, :, :, None] * rows[0] + A[1, :, :, None] * rows[1]).reshape(X.shape)


class SummedOperator(eqx.Module):
    """Sums of products instead of matrix products.

    In a scan of small steps the number of operations costs, not their size: products with the same
    matrix are taken together.
    """

    transpose_product: Callable[[Array, Array], Array] = eqx.field(static=True)
    symmetric_every: int = eqx.field(static=True, default=1)

    def products(self, P: Array, p: Array, A: Array, B: Array, offset: Array) -> Products:
        """See `DynamicsOperator`."""
        size = P.shape[0]
        X = jnp.concatenate([B, offset[:, None]], axis=1)
        onward = jnp.sum(P[:, :, None] * X, axis=1)
        PB, w = onward[:, :-1], onward[:, -1] + p
        pulled = self.transpose_product(A, jnp.concatenate([P, PB, w[:, None]], axis=1))
        return Products(PB, w, pulled[:, size:-1].T, pulled[:, -1], pulled[:, :size])

    def update(self, products: Products, A: Array, Q: Array, K: Array, step: Array) -> Array:
        """See `DynamicsOperator`."""
        P = Q + self.transpose_product(A, products.P.T)
        return P + jnp.sum(products.G[:, :, None] * K[:, None, :], axis=0)


class DenseOperator(eqx.Module):
    """Thin products from the left: P is symmetric, and its rows lie in one piece."""

    symmetric_every: int = eqx.field(static=True, default=_LARGE_EVERY)

    def products(self, P: Array, p: Array, A: Array, B: Array, offset: Array) -> Products:
        """See `DynamicsOperator`."""
        onward = (jnp.concatenate([B.T, offset[None]]) @ P).at[-1].add(p)
        pulled = onward @ A
        return Products(onward[:-1].T, onward[-1], pulled[:-1], pulled[-1], P)

    def update(self, products: Products, A: Array, Q: Array, K: Array, step: Array) -> Array:
        """See `DynamicsOperator`."""
        return Q + A.T @ (products.P @ A) + _outer(products.G, K)


class BlockOperator(eqx.Module):
    """As `DenseOperator`; A's quadrants are diagonal, so that products with A are elementwise."""

    symmetric_every: int = eqx.field(static=True, default=_LARGE_EVERY)

    def products(self, P: Array, p: Array, A: Array, B: Array, offset: Array) -> Products:
        """See `DynamicsOperator`."""
        onward = (jnp.concatenate([B.T, offset[None]]) @ P).at[-1].add(p).T
        pulled = block_product(A, onward)
        return Products(onward[:, :-1], onward[:, -1], pulled[:, :-1].T, pulled[:, -1], P)

    def update(self, products: Products, A: Array, Q: Array, K: Array, step: Array) -> Array:
        """See `DynamicsOperator`.

        XLA does not fuse across a conditional's bounds, which is this one's only purpose: within
        it, neither this step's inputs are read out of the arrays of all steps nor is P written
        over, either of which keeps XLA from vectorising. It makes the step three times faster.
        """
        return Q + jax.lax.cond(step >= 0, _moved, _moved, products.P, A, products.G, K)


def _moved(
    P: Float[Array, "n n"], A: Float[Array, "2 2 m"], G: Float[Array, "U n"], K: Array
) -> Float[Array, "n n"]:
    """``A^T P A + G^T K`` in two halves, P's columns of positions and of velocities: XLA vectorises
    along the rows of such planes."""
    count = A.shape[-1]
    planes = P.reshape(2, count, 2, count)
    G, K = G.reshape(-1, 2, count), K.reshape(-1, 2, count)

    def half(j: int) -> Float[Array, "n m"]:
        rows = planes[:, :, 0] * A[0, j] + planes[:, :, 1] * A[1, j]
        moved = A[0][:, :, None] * rows[0] + A[1][:, :, None] * rows[1]
        return (moved + _outer(G, K[:, j])).reshape(-1, count)

    return jnp.concatenate([half(0), half(1)], axis=1)


def _outer(G: Float[Array, "U ..."], K: Float[Array, "U m"]) -> Float[Array, "... m"]:
    """``G^T K``, written out: U is small, and sums over an axis are not vectorised here."""
    total = G[0][..., None] * K[0]
    for row in range(1, G.shape[0]):
        total = total + G[row][..., None] * K[row]
    return total
