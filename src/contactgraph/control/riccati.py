"""How the Riccati pass takes P through one step's dynamics.

The notation is that of `contactgraph.control.lqr`. Three forms of the same products, each the
fastest somewhere:

- `SummedForm`, for few states, of any A: products written as sums, which inside a scan XLA makes
  few kernels of, while a call of a matrix product costs more than all the rest of a step.
- `DenseForm`, for many states and a dense A: two products of the size of A a step.
- `BlockForm`, for many states and the model's A: n^2 instead of n^3 operations.

P must stay symmetric: what rounding adds to its antisymmetric part grows with ``A^T (.) A``, which
no feedback holds. Reading a large P along its columns costs as much as the rest of a step, so the
large forms ask for it only after several steps.
"""

from collections.abc import Callable
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_SUMMED_SIZE = 16
_LARGE_EVERY = 8

TransposeProduct = Callable[[Array, Float[Array, "n c"]], Float[Array, "n c"]]
"""``A^T X`` from one step's A, however that is stored, and ``X``."""


class Ahead(eqx.Module):
    """The cost-to-go of the step after, seen through one step's dynamics."""

    PB: Float[Array, "n U"]
    """``P' B``"""
    w: Float[Array, " n"]
    """``P' offset + p'``"""
    G: Float[Array, "U n"]
    """``B^T P' A``"""
    slope: Float[Array, " n"]
    """``A^T w``"""
    kept: Any
    """What the form needs for `RiccatiForm.before`."""


class RiccatiForm(Protocol):
    """What the Riccati pass asks for; A is one step's, however the form has it stored."""

    @property
    def symmetric_every(self) -> int:
        """`symmetric` is asked for after at most so many steps."""
        ...

    def ahead(self, P: Float[Array, "n n"], p: Array, A: Array, B: Array, offset: Array) -> Ahead:
        """All products with P' and A that the control's problem needs."""
        ...

    def before(
        self, ahead: Ahead, A: Array, Q: Float[Array, "n n"], K: Array, step: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """``Q + A^T P' A + G^T K``."""
        ...

    def symmetric(self, P: Float[Array, "n n"]) -> Float[Array, "n n"]:
        """The mean of P and its transpose."""
        ...


Form = Callable[[int], RiccatiForm]
"""The form for this many states."""


def dense_form(size: int) -> RiccatiForm:
    """For a dense A [n, n]."""
    return DenseForm() if size > _SUMMED_SIZE else SummedForm(dense_product)


def block_form(size: int) -> RiccatiForm:
    """For block diagonal A [2, 2, n/2]: states are all positions, then all velocities.

    ``A[i, j]`` is the diagonal of the quadrant in row i and column j.
    """
    return BlockForm() if size > _SUMMED_SIZE else SummedForm(block_product)


def dense_product(A: Float[Array, "n n"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for a dense A."""
    if A.shape[0] > _SUMMED_SIZE:
        return A.T @ X
    return jnp.sum(A[:, :, None] * X[:, None, :], axis=0)


def block_product(A: Float[Array, "2 2 m"], X: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """``A^T X`` for block diagonal A, ``n = 2m``."""
    rows = X.reshape(2, A.shape[-1], -1)
    return (A[0, :, :, None] * rows[0] + A[1, :, :, None] * rows[1]).reshape(X.shape)


class SummedForm(eqx.Module):
    """P is a matrix; sums of products instead of matrix products."""

    transpose_product: TransposeProduct = eqx.field(static=True)
    symmetric_every: int = eqx.field(static=True, default=1)

    def ahead(self, P: Float[Array, "n n"], p: Array, A: Array, B: Array, offset: Array) -> Ahead:
        """Products with the same matrix are taken together.

        In a scan of small steps it is the number of operations that costs, not their size.
        """
        size = P.shape[0]
        X = jnp.concatenate([B, offset[:, None]], axis=1)
        onward = jnp.sum(P[:, :, None] * X, axis=1)
        PB, w = onward[:, :-1], onward[:, -1] + p
        pulled = self.transpose_product(A, jnp.concatenate([P, PB, w[:, None]], axis=1))
        return Ahead(PB, w, pulled[:, size:-1].T, pulled[:, -1], pulled[:, :size])

    def before(
        self, ahead: Ahead, A: Array, Q: Float[Array, "n n"], K: Array, step: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """``Q + A^T P' A + G^T K``."""
        P = Q + self.transpose_product(A, ahead.kept.T)
        return P + jnp.sum(ahead.G[:, :, None] * K[:, None, :], axis=0)

    def symmetric(self, P: Float[Array, "n n"]) -> Float[Array, "n n"]:
        """The mean of P and its transpose."""
        return _symmetric(P)


class DenseForm(eqx.Module):
    """P is a matrix, A is one too."""

    symmetric_every: int = eqx.field(static=True, default=_LARGE_EVERY)

    def ahead(self, P: Float[Array, "n n"], p: Array, A: Array, B: Array, offset: Array) -> Ahead:
        """Thin products, from the left: P is symmetric, and its rows lie in one piece."""
        onward = jnp.concatenate([B.T, offset[None]]) @ P
        onward = onward.at[-1].add(p)
        pulled = onward @ A
        return Ahead(onward[:-1].T, onward[-1], pulled[:-1], pulled[-1], P)

    def before(
        self, ahead: Ahead, A: Array, Q: Float[Array, "n n"], K: Array, step: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """``Q + A^T P' A + G^T K``."""
        return Q + A.T @ (ahead.kept @ A) + _outer(ahead.G, K)

    def symmetric(self, P: Float[Array, "n n"]) -> Float[Array, "n n"]:
        """The mean of P and its transpose."""
        return _symmetric(P)


class BlockForm(eqx.Module):
    """P is a matrix; A's quadrants are diagonal, so that ``A^T P A`` is elementwise in P's."""

    symmetric_every: int = eqx.field(static=True, default=_LARGE_EVERY)

    def ahead(self, P: Float[Array, "n n"], p: Array, A: Array, B: Array, offset: Array) -> Ahead:
        """Thin products, from the left; none with A is more than elementwise."""
        onward = (jnp.concatenate([B.T, offset[None]]) @ P).at[-1].add(p).T
        pulled = block_product(A, onward)
        return Ahead(onward[:, :-1], onward[:, -1], pulled[:, :-1].T, pulled[:, -1], P)

    def before(
        self, ahead: Ahead, A: Array, Q: Float[Array, "n n"], K: Array, step: Int[Array, ""]
    ) -> Float[Array, "n n"]:
        """``Q + A^T P' A + G^T K``.

        XLA does not fuse across a conditional's bounds, and that is all this one is for: within
        it, neither this step's inputs are read out of the arrays of all steps nor is P written
        over, either of which keeps XLA from vectorising. It makes the step three times faster.
        """
        return Q + jax.lax.cond(step >= 0, _moved, _moved, ahead.kept, A, ahead.G, K)

    def symmetric(self, P: Float[Array, "n n"]) -> Float[Array, "n n"]:
        """The mean of P and its transpose."""
        return _symmetric(P)


def _moved(
    P: Float[Array, "n n"], A: Float[Array, "2 2 m"], G: Float[Array, "U n"], K: Array
) -> Float[Array, "n n"]:
    """``A^T P A + G^T K``, made as two halves, P's columns of positions and of velocities: along
    the rows of such planes XLA vectorises."""
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


def _symmetric(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return 0.5 * (P + P.T)
