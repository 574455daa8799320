r"""Solves with the mass matrix of a scene, $H = M + J^T \Lambda J$, dense or block by block.

Both methods give the same result. `solve_dense` inverts one matrix, for scenes of any shape.
`solve_block_diagonal` inverts one block for each group of coupled nodes; all other blocks are zero.
Its derivatives are still those of the whole matrix, including edges without stiffness between two
groups, because a model learns contact from the effect that such edges would have.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import sum_at_nodes
from contactgraph.bodies.mass_matrix import MassMatrix, MassMatrixSolution, spd_inverse


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


@dataclasses.dataclass(frozen=True)
class GroupsOf:
    """The `GroupCapacity` of this number of ``nodes``."""

    nodes: int

    def solve(self, matrix: MassMatrix, vectors: Float[Array, "N d c"]) -> MassMatrixSolution:
        """See `solve_block_diagonal`."""
        return solve_block_diagonal(matrix, vectors, self.nodes)


def solve_block_diagonal(
    matrix: MassMatrix, vectors: Float[Array, "N d c"], capacity: int
) -> MassMatrixSolution:
    """Solve by the inverses of the groups. NaN where one has more nodes than `capacity`."""
    fixed = jax.lax.stop_gradient(matrix)
    count, size = matrix.node.shape
    edge_index = matrix.rows.edge_index
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
    jacobian = matrix.rows.contact_jacobian
    diagonal = _diagonal(matrix.node, matrix.edge, jacobian, edge_index, groups, inverse)
    return MassMatrixSolution(solution, diagonal)


def _blocks(matrix: MassMatrix, groups: Groups, capacity: int) -> Float[Array, "N s s"]:
    """Each group's block of the matrix, a row for each `Groups.group`; identity in empty slots."""
    (count, size), rows = matrix.node.shape, matrix.rows
    first, second = rows.edge_index
    jacobian, edge = rows.contact_jacobian, matrix.edge[:, None, None]
    outside = count * capacity * capacity

    def entry(one: Int[Array, " m"], other: Int[Array, " m"]) -> Int[Array, " m"]:
        row, column = groups.slot[one], groups.slot[other]
        index = (groups.group[one] * capacity + row) * capacity + column
        return jnp.where((row < capacity) & (column < capacity), index, outside)

    identity = jnp.eye(size, dtype=matrix.node.dtype)
    own = edge * jnp.einsum("seji,sejk->seik", jacobian, jacobian)
    own = sum_at_nodes(own, rows.edge_index, count)
    own = own + matrix.node[:, :, None] * identity
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
