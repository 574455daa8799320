r"""Solves with the mass matrix of a scene, $H = M + J^T \Lambda J$, dense or block by block.

Both methods give the same result. `solve_dense` inverts one matrix, for scenes of any shape.
`solve_block_diagonal` inverts one block for each group of coupled nodes; all other blocks are zero.
Its derivatives are still those of the whole matrix, including edges without stiffness between two
groups, because a model learns contact from the effect that such edges would have.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.collision import Joined
from contactgraph.model.neighbor_list import sum_at_nodes

_UNROLLED_SIZE = 6
"""Rows up to which matrices are inverted in unrolled operations that fuse."""
_SUMMED_SIZE = 20
"""Rows up to which matrices are multiplied as sums: in a batch a product is a call for each."""
_ELIMINATED_SIZE = 32
"""Rows up to which a batch of matrices is inverted faster here than by LAPACK."""


class Groups(eqx.Module):
    """Groups of nodes that edges connect: the group of every node, and its slot in the group."""

    group: Int[Array, " N"]
    """The smallest index of a node of the group."""
    slot: Int[Array, " N"]
    """0, 1, 2, … within a group."""

    @property
    def largest(self) -> Int[Array, ""]:
        """Number of nodes of the largest group."""
        return jnp.max(self.slot) + 1


def find_groups(joins: Bool[Array, " E"], edge_index: Int[Array, "2 E"], count: int) -> Groups:
    """The connected components of `count` nodes under the edges that join their nodes."""
    first, second = edge_index
    node = jnp.arange(count, dtype=edge_index.dtype)

    def apart(root: Int[Array, " N"]) -> Bool[Array, " E"]:
        return joins & (root[first] != root[second])

    def merge(root: Int[Array, " N"]) -> Int[Array, " N"]:
        one, other = root[first], root[second]
        high = jnp.where(apart(root), jnp.maximum(one, other), count)
        root = root.at[high].min(jnp.minimum(one, other), mode="drop")
        return root[root]

    root = jax.lax.while_loop(lambda root: jnp.any(apart(root)), merge, node)
    order = jnp.argsort(root)
    gathered = root[order]
    begins = jnp.concatenate([jnp.ones(1, bool), gathered[1:] != gathered[:-1]])
    begin = jax.lax.cummax(jnp.where(begins, node, 0))
    return Groups(root, jnp.zeros_like(node).at[order].set(node - begin))


class MassMatrix(eqx.Module):
    """H as a linear operator, with `d` rows for each node: 1 where no hinge turns velocities."""

    node: Float[Array, "N d"] | Float[Array, "N 1"]
    """Diagonal part, kg."""
    edge: Float[Array, " E"]
    """Stiffness of each edge, kg."""
    geometry: Joined

    @property
    def size(self) -> int:
        """d, rows per node."""
        return self.geometry.contact_jacobian.shape[-1]

    @property
    def rows(self) -> Float[Array, "N d"]:
        """The diagonal part of every row."""
        return jnp.broadcast_to(self.node, (len(self.node), self.size))

    def __call__(self, x: Float[Array, "N d c"]) -> Float[Array, "N d c"]:
        """The product with c vectors."""
        on_edges = self.edge[:, None, None] * relative_at_edges(x, self.geometry)
        return self.node[:, :, None] * x + to_nodes(on_edges, self.geometry, x.shape[0])


class MassMatrixSolution(eqx.Module):
    """The parts of the inverse that a step needs."""

    solution: Float[Array, "N d c"]
    """Its products with c vectors."""
    diagonal: Float[Array, "N d"]
    """Its diagonal; 1/kg."""


def relative_at_edges(x: Float[Array, "N d c"], geometry: Joined) -> Float[Array, "E d c"]:
    """J x: the difference of the edges' second and first nodes, at the points of contact."""
    jacobian = geometry.contact_jacobian
    first, second = x[geometry.edge_index[0]], x[geometry.edge_index[1]]
    if jacobian.shape[-1] == 1:
        return second - first
    return jnp.einsum("eij,ejc->eic", jacobian[1], second) - jnp.einsum(
        "eij,ejc->eic", jacobian[0], first
    )


def to_nodes(on_edges: Float[Array, "E d c"], geometry: Joined, count: int) -> Array:
    """J^T of values on the edges, [N, d, c]."""
    arriving = jnp.stack([-on_edges, on_edges])
    if geometry.contact_jacobian.shape[-1] > 1:
        arriving = jnp.einsum("seji,sejc->seic", geometry.contact_jacobian, arriving)
    return sum_at_nodes(arriving, geometry.edge_index, count)


def solve_dense(matrix: MassMatrix, vectors: Float[Array, "N d c"]) -> MassMatrixSolution:
    """Solve by the inverse of the whole matrix."""
    count, size = matrix.node.shape[0], matrix.size
    jacobian = _dense_jacobian(matrix.geometry, count)
    edge, node = (
        jnp.repeat(matrix.edge, matrix.geometry.contact_jacobian.shape[2]),
        matrix.rows.ravel(),
    )
    inverse = dense_inverse(product(jacobian.T, edge[:, None] * jacobian) + jnp.diag(node))
    solution = product(inverse, vectors.reshape(count * size, -1)).reshape(vectors.shape)
    diagonal = jnp.sum(inverse * jnp.eye(count * size, dtype=inverse.dtype), axis=1)
    return MassMatrixSolution(solution, diagonal.reshape(count, size))


def product(one: Float[Array, "n m"], other: Float[Array, "m c"]) -> Float[Array, "n c"]:
    """The matrix product; of small matrices as a sum, which fuses with neighbouring operations."""
    if max(one.shape) > _SUMMED_SIZE:
        return one @ other
    return jnp.sum(one[:, :, None] * other[None], axis=1)


def _dense_jacobian(geometry: Joined, count: int) -> Float[Array, "Ed Nd"]:
    """J, from all velocities to the relative velocities along all edges."""
    jacobian = geometry.contact_jacobian
    size = jacobian.shape[-1]
    first, second = geometry.incidence(count)
    blocks = second[:, None, :, None] * jacobian[1][:, :, None, :]
    blocks = blocks - first[:, None, :, None] * jacobian[0][:, :, None, :]
    return blocks.reshape(blocks.shape[0] * blocks.shape[1], count * size)


def solve_block_diagonal(
    matrix: MassMatrix, vectors: Float[Array, "N d c"], capacity: int
) -> MassMatrixSolution:
    """Solve by the inverses of the groups. NaN where one has more nodes than `capacity`."""
    fixed = jax.lax.stop_gradient(matrix)
    count, size = matrix.node.shape[0], matrix.size
    edge_index = matrix.geometry.edge_index
    groups = find_groups(fixed.edge > 0, edge_index, count)
    blocks = jnp.where(groups.largest <= capacity, _blocks(fixed, groups, capacity), jnp.nan)
    rows = size * jnp.minimum(groups.largest, capacity)
    inverse = spd_inverse(blocks, rows).reshape(count, capacity, size, capacity, size)
    row = groups.group * capacity + jnp.minimum(groups.slot, capacity - 1)

    def solve(_: object, right: Float[Array, "N d c"]) -> Float[Array, "N d c"]:
        inside = jnp.zeros((count * capacity, *right.shape[1:]), right.dtype).at[row].set(right)
        inside = inside.reshape(count, capacity * size, -1)
        flat = inverse.reshape(count, capacity * size, capacity * size)
        return (flat @ inside).reshape(count * capacity, *right.shape[1:])[row]

    solution = jax.lax.custom_linear_solve(matrix, vectors, solve, symmetric=True)
    jacobian = matrix.geometry.contact_jacobian
    diagonal = _diagonal(matrix.rows, matrix.edge, jacobian, edge_index, groups, inverse)
    return MassMatrixSolution(solution, diagonal)


def _blocks(matrix: MassMatrix, groups: Groups, capacity: int) -> Float[Array, "N s s"]:
    """Each group's block of the matrix, a row for each `Groups.group`; identity in empty slots."""
    count, size, geometry = matrix.node.shape[0], matrix.size, matrix.geometry
    first, second = geometry.edge_index
    jacobian, edge = geometry.contact_jacobian, matrix.edge[:, None, None]
    outside = count * capacity * capacity

    def entry(one: Int[Array, " m"], other: Int[Array, " m"]) -> Int[Array, " m"]:
        row, column = groups.slot[one], groups.slot[other]
        index = (groups.group[one] * capacity + row) * capacity + column
        return jnp.where((row < capacity) & (column < capacity), index, outside)

    identity = jnp.eye(size, dtype=matrix.node.dtype)
    own = edge * jnp.einsum("seji,sejk->seik", jacobian, jacobian)
    own = sum_at_nodes(own, geometry.edge_index, count)
    own = own + matrix.rows[:, :, None] * identity
    cross = -edge * jnp.einsum("eji,ejk->eik", jacobian[0], jacobian[1])
    joins = matrix.edge > 0
    node = jnp.arange(count)
    empty = jnp.eye(capacity, dtype=identity.dtype).reshape(-1, 1, 1) * identity
    flat = jnp.tile(empty, (count, 1, 1)).at[entry(node, node)].set(own, mode="drop")
    flat = flat.at[jnp.where(joins, entry(first, second), outside)].add(cross, mode="drop")
    back = jnp.swapaxes(cross, 1, 2)
    flat = flat.at[jnp.where(joins, entry(second, first), outside)].add(back, mode="drop")
    blocks = jnp.swapaxes(flat.reshape(count, capacity, capacity, size, size), 2, 3)
    return blocks.reshape(count, capacity * size, capacity * size)


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


@jax.custom_jvp
def _diagonal(
    node: Float[Array, "N d"],
    edge: Float[Array, " E"],
    jacobian: Float[Array, "2 E i d"],
    edge_index: Int[Array, "2 E"],
    groups: Groups,
    inverse: Float[Array, "N s d s d"],
) -> Float[Array, "N d"]:
    """The diagonal of the inverse, from its blocks by group."""
    blocks = inverse[groups.group, groups.slot, :, groups.slot, :]
    return jnp.diagonal(blocks, axis1=1, axis2=2)


@_diagonal.defjvp
def _diagonal_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # With c a node's column of the inverse, its entry changes by -c^T dH c.
    _, _, _, edge_index, groups, inverse = primals

    def square(node: Array, edge: Array, jacobian: Array) -> Float[Array, "N d"]:
        """c^T H c of every node's own columns, which are zero outside of its group."""
        inside = jnp.zeros(inverse.shape[:3], node.dtype).at[groups.group, groups.slot].set(node)
        total = jnp.einsum("gmi,gmisk->gsk", inside, inverse**2)
        # [2, E, d, s, d]: columns of its group as they appear at each end of an edge.
        at_end = inverse[groups.group[edge_index], groups.slot[edge_index]]
        at_end = jnp.einsum("teij,tejsk->teisk", jacobian, at_end)
        same = groups.group[edge_index[0]] == groups.group[edge_index[1]]
        both = jnp.sum((at_end[1] - at_end[0]) ** 2, axis=1)
        alone = jnp.sum(at_end**2, axis=2)
        split = jnp.stack([jnp.where(same[:, None, None], both, alone[0]), alone[1]])
        split = split.at[1].multiply(~same[:, None, None])
        at_groups = sum_at_nodes(
            edge[:, None, None] * split, groups.group[edge_index], inverse.shape[0]
        )
        return (total + at_groups)[groups.group, groups.slot]

    change = jax.jvp(square, primals[:3], tangents[:3])[1]
    return _diagonal(*primals), -change
