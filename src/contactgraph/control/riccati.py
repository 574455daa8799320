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

A `DynamicsOperator` makes the products with A and B. Four are here, each the fastest somewhere:

- `_SummedOperator`, for few states and any A: products written as sums, of which XLA makes few
  kernels inside a scan, while a call of a matrix product costs more than all the rest of a step.
- `_DenseOperator`, for many states and a dense A: two products of the size of A a step.
- `_BlockOperator`, for many states and the model's A: n^2 instead of n^3 operations.
- `_BandedOperator`, for so many that P does not fit the caches: a step costs what it reads and
  writes, and two thirds of P are enough.

A fifth, for batches of small problems, is in `contactgraph.control.lqr_adjoint`.

P must stay symmetric: rounding errors in its antisymmetric part grow with ``A^T (.) A``, which no
feedback holds. Reading a large P along its columns costs as much as the rest of a step, so the
large operators ask for it only after several steps.
"""

import abc
import itertools
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from contactgraph.control.box_qp import SUMMED_SIZE

_BANDED_SIZE = 256
_BANDS = 3
"""More bands store less twice, and take more products with thin matrices."""
_VECTOR = 8
"""Bands begin at a multiple of it: XLA computes one by one what is left of a row."""


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
    P: PyTree[Array]
    """``P'`` as stored, or ``A^T P'``, as `DynamicsOperator.update` needs it."""


class DynamicsOperator(eqx.Module):
    """The products that the Riccati recursion needs of one step, however its A and P are stored."""

    symmetric_every: ClassVar[float] = 8
    """P is made symmetric after at most so many steps."""
    reads_ahead: ClassVar[bool] = False
    """See `contactgraph.control.lqr.scan_stages`."""

    def store(self, P: Float[Array, "n n *batch"]) -> PyTree[Array]:
        """A symmetric P as the recursion carries it."""
        return P

    def restore(self, stored: PyTree[Array]) -> Float[Array, "n n *batch"]:
        """The matrix that `store` was given."""
        return stored

    def symmetric(self, stored: PyTree[Array]) -> PyTree[Array]:
        """Without the antisymmetric part of what is stored."""
        return 0.5 * (stored + stored.swapaxes(0, 1))

    @abc.abstractmethod
    def products(self, P: PyTree[Array], p: Array, stage: LQRProblem) -> Products:
        """All products with P' and p' that the control's problem needs; P' as stored."""

    @abc.abstractmethod
    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> PyTree[Array]:
        """``Q + A^T P' A + G^T K`` as stored."""


Operator = Callable[[int], DynamicsOperator]
"""The operator for this many states."""


def dense_operator(size: int) -> DynamicsOperator:
    """For a dense A [n, n]."""
    return _DenseOperator() if size > SUMMED_SIZE else _SummedOperator(dense_product)


def block_operator(size: int) -> DynamicsOperator:
    """For block diagonal A [2, 2, n/2]: states are all positions, then all velocities.

    ``A[i, j]`` is the diagonal of the quadrant in row i and column j.
    """
    if size >= _BANDED_SIZE:
        return _BandedOperator(size // 2)
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

    def products(self, P: PyTree[Array], p: Array, stage: LQRProblem) -> Products:
        X = jnp.concatenate([stage.B.T, stage.offset[None]])
        onward = self._from_left(X, P).at[-1].add(p).T
        pulled = block_product(stage.A, onward).T
        return _products(stage, p, onward[:, :-1], onward[:, -1], pulled, P)

    def update(self, now: Products, stage: LQRProblem, K: Array, step: Array) -> PyTree[Array]:
        # XLA does not fuse across a conditional's bounds, which is this one's only purpose: within
        # it, neither this step's inputs are read out of the arrays of all steps nor is P written
        # over, either of which keeps XLA from vectorising. It makes the step three times faster.
        count = stage.A.shape[-1]
        arguments = now.P, stage.A, now.G.reshape(-1, 2, count), K.reshape(-1, 2, count)
        moved = jax.lax.cond(step >= 0, self._moved, self._moved, *arguments)
        return jax.tree.map(jnp.add, self.store(stage.Q), moved)

    def _from_left(self, X: Float[Array, "c n"], P: PyTree[Array]) -> Float[Array, "c n"]:
        """``X P``."""
        return X @ P

    def _moved(
        self, P: PyTree[Array], A: Array, G: Float[Array, "U 2 m"], K: Float[Array, "U 2 m"]
    ) -> PyTree[Array]:
        """``A^T P A + G^T K`` in two halves, P's columns of positions and of velocities: XLA
        vectorises along the rows of such planes."""
        count = A.shape[-1]
        planes = P.reshape(2, count, 2, count)

        def half(j: int) -> Float[Array, "n m"]:
            rows = planes[:, :, 0] * A[0, j] + planes[:, :, 1] * A[1, j]
            moved = A[0][:, :, None] * rows[0] + A[1][:, :, None] * rows[1]
            return (moved + _outer(G, K[:, j])).reshape(-1, count)

        return jnp.concatenate([half(0), half(1)], axis=1)


Bands = tuple[Float[Array, "rows 2 2 columns"], ...]
"""The upper triangle of a symmetric matrix, see `_BandedOperator`."""


class _BandedOperator(_BlockOperator):
    """P in bands of the rows of some degrees of freedom, from their diagonal block on.

    Rows are ordered ``[degree of freedom, position or velocity]`` and columns the other way round:
    a row of A^T P A is made of two neighbouring ones, and read from memory once.
    """

    count: int = eqx.field(static=True)
    """Degrees of freedom, n/2."""

    @property
    def limits(self) -> list[tuple[int, int]]:
        """The first row of each band, and the one past its last."""
        edges = [_VECTOR * round(self.count * i / _BANDS / _VECTOR) for i in range(_BANDS)]
        return list(itertools.pairwise([*edges, self.count]))

    def store(self, P: Float[Array, "n n"]) -> Bands:
        rows = P.reshape(2, self.count, 2, self.count)
        return tuple(rows[:, begin:end, :, begin:].swapaxes(0, 1) for begin, end in self.limits)

    def restore(self, stored: Bands) -> Float[Array, "n n"]:
        whole = jnp.zeros((self.count, 2, 2, self.count), stored[0].dtype)
        for (begin, end), band in zip(self.limits, stored, strict=True):
            whole = whole.at[begin:end, :, :, begin:].set(band)
            whole = whole.at[end:, :, :, begin:end].set(band[..., end - begin :].transpose())
        return whole.swapaxes(0, 1).reshape(2 * self.count, 2 * self.count)

    def symmetric(self, stored: Bands) -> Bands:
        def one(band: Array) -> Array:
            square = band[..., : len(band)]
            return band.at[..., : len(band)].set(0.5 * (square + square.transpose()))

        return tuple(one(band) for band in stored)

    def _from_left(self, X: Float[Array, "c n"], P: Bands) -> Float[Array, "c n"]:
        # A band's columns get its rows' part, and its rows that of the columns after them.
        X = X.reshape(-1, 2, self.count)
        total = jnp.zeros_like(X)
        for (begin, end), band in zip(self.limits, P, strict=True):
            flat = band.reshape(2 * (end - begin), -1)
            rows = X[:, :, begin:end].swapaxes(1, 2).reshape(len(X), -1) @ flat
            total = total.at[:, :, begin:].add(rows.reshape(len(X), 2, -1))
            if end < self.count:
                after = X[:, :, begin:].at[:, :, : end - begin].set(0.0)
                columns = (after.reshape(len(X), -1) @ flat.T).reshape(len(X), -1, 2)
                total = total.at[:, :, begin:end].add(columns.swapaxes(1, 2))
        return total.reshape(len(X), -1)

    def _moved(
        self, P: Bands, A: Array, G: Float[Array, "U 2 m"], K: Float[Array, "U 2 m"]
    ) -> Bands:
        A_rows, G_rows = jnp.moveaxis(A, -1, 1)[..., None, None], jnp.moveaxis(G, -1, 1)

        def one(band: Array, begin: int, end: int) -> Array:
            left, right = A_rows[:, begin:end], A[..., begin:]
            columns = band[:, :, :1] * right[0] + band[:, :, 1:] * right[1]
            rows = left[0] * columns[:, :1] + left[1] * columns[:, 1:]
            return rows + _outer(G_rows[:, begin:end], K[..., begin:])

        return tuple(one(band, *limits) for band, limits in zip(P, self.limits, strict=True))


def _outer(G: Float[Array, "U ..."], K: Float[Array, "U ..."]) -> Float[Array, "..."]:
    """``G^T K``, written out: U is small, and sums over an axis are not vectorised here."""
    G = G.reshape(*G.shape, *[1] * (K.ndim - 1))
    total = G[0] * K[0]
    for row in range(1, G.shape[0]):
        total = total + G[row] * K[row]
    return total


def _products(
    stage: LQRProblem, p: Array, PB: Array, w: Array, pulled: Float[Array, "U+1 n"], P: PyTree
) -> Products:
    """``pulled`` is the transpose of ``A^T [P' B, w]``."""
    slopes = dense_product(stage.B, jnp.concatenate([PB, w[:, None]], axis=1))
    S, g = stage.R + slopes[:, :-1], stage.r + slopes[:, -1]
    return Products(S, pulled[:-1], g, pulled[-1], stage.offset @ (w + p), P)
