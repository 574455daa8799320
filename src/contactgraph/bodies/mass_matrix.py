r"""The mass matrix of a scene, $H = M + J^T \Lambda J$: its products, and its inverse."""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.bodies.geometry import Rows

_UNROLLED_SIZE = 6
"""Rows up to which matrices are inverted in unrolled operations that fuse."""
_SUMMED_SIZE = 20
"""Rows up to which matrices are multiplied as sums: in a batch a product is a call for each."""
_ELIMINATED_SIZE = 32
"""Rows up to which a batch of matrices is inverted faster here than by LAPACK."""


class MassMatrix(eqx.Module):
    """H as a linear operator, with `d` rows for each node: 1 where no hinge turns velocities."""

    node: Float[Array, "N d"]
    """Diagonal part, kg."""
    edge: Float[Array, " E"]
    """Stiffness of each edge, kg."""
    rows: Rows

    def __call__(self, x: Float[Array, "N d c"]) -> Float[Array, "N d c"]:
        """The product with c vectors."""
        on_rows = self.edge[:, None, None] * self.rows.relative(x)
        return self.node[:, :, None] * x + self.rows.to_nodes(on_rows, x.shape[0])


class MassMatrixSolution(eqx.Module):
    """The parts of the inverse that a step needs."""

    solution: Float[Array, "N d c"]
    """Its products with c vectors."""
    diagonal: Float[Array, "N d"]
    """Its diagonal; 1/kg."""


class GroupCapacity(Protocol):
    """Most nodes that contacts couple, directly or through others; it solves group by group."""

    @property
    def nodes(self) -> int:
        """That number."""

    def solve(self, matrix: MassMatrix, vectors: Float[Array, "N d c"]) -> MassMatrixSolution:
        """As `solve_dense`; NaN where more nodes are coupled."""


def solve(
    matrix: MassMatrix, vectors: Float[Array, "N d c"], capacity: GroupCapacity | None
) -> MassMatrixSolution:
    """By groups of coupled nodes of this ``capacity``; None: all at once."""
    return solve_dense(matrix, vectors) if capacity is None else capacity.solve(matrix, vectors)


def solve_dense(matrix: MassMatrix, vectors: Float[Array, "N d c"]) -> MassMatrixSolution:
    """Solve by the inverse of the whole matrix."""
    (count, size), rows = matrix.node.shape, matrix.rows
    jacobian = rows.dense(count)
    edge = jnp.repeat(matrix.edge, rows.contact_jacobian.shape[2])
    whole = product(jacobian.T, edge[:, None] * jacobian) + jnp.diag(matrix.node.ravel())
    inverse = dense_inverse(whole)
    solution = product(inverse, vectors.reshape(count * size, -1)).reshape(vectors.shape)
    diagonal = jnp.sum(inverse * jnp.eye(count * size, dtype=inverse.dtype), axis=1)
    return MassMatrixSolution(solution, diagonal.reshape(count, size))


def product(one: Float[Array, "n m"], other: Float[Array, "m c"]) -> Float[Array, "n c"]:
    """The matrix product; of small matrices as a sum, which fuses with neighbouring operations."""
    if max(one.shape) > _SUMMED_SIZE:
        return one @ other
    return jnp.sum(one[:, :, None] * other[None], axis=1)


def spd_inverse(
    matrix: Float[Array, "*B n n"], rows: Int[Array, ""] | int
) -> Float[Array, "*B n n"]:
    """Inverses of a batch of small, symmetric positive definite matrices.

    Rows and columns from index `rows` on must be those of the identity.
    """
    return jax.lax.fori_loop(0, rows, _eliminate, matrix)


def _eliminate(pivot: Int[Array, ""] | int, matrix: Float[Array, "*B n n"]) -> Array:
    """One round of Gauss-Jordan; positive definite matrices need no pivoting."""
    index = jnp.arange(matrix.shape[-1])
    row = jax.lax.dynamic_slice_in_dim(matrix, pivot, 1, -2)
    column = jax.lax.dynamic_slice_in_dim(matrix, pivot, 1, -1)
    scale = 1.0 / jax.lax.dynamic_slice_in_dim(row, pivot, 1, -1)
    in_row, in_column = index[:, None] == pivot, index[None, :] == pivot
    rest = matrix - column * (row * scale)
    rest = jnp.where(in_row, row * scale, jnp.where(in_column, -column * scale, rest))
    return jnp.where(in_row & in_column, scale, rest)


@jax.custom_jvp
def dense_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of one symmetric positive definite matrix."""
    size = matrix.shape[0]
    # LAPACK inverts the matrices of a batch one after the other.
    if size > _ELIMINATED_SIZE:
        return jnp.linalg.inv(matrix)
    if size > _UNROLLED_SIZE:
        return spd_inverse(matrix, size)
    for pivot in range(size):
        matrix = _eliminate(pivot, matrix)
    return matrix


@dense_inverse.defjvp
def _dense_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = dense_inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse
