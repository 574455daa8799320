"""Who holds whom: nodes that edges join are one group."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model.collision import Geometry
from contactgraph.model.graph import sum_at_nodes


class Groups(eqx.Module):
    """The group of every node, and its place in the group."""

    group: Int[Array, " N"]
    """The least of the group's nodes."""
    slot: Int[Array, " N"]
    """0, 1, 2, … within a group."""

    @property
    def largest(self) -> Int[Array, ""]:
        """How many nodes the largest group has."""
        return jnp.max(self.slot) + 1


def find_groups(joins: Bool[Array, " E"], ends: Int[Array, "2 E"], count: int) -> Groups:
    """The groups of `count` nodes that the edges make which join their ends."""
    first, second = ends
    node = jnp.arange(count, dtype=ends.dtype)

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


_UNROLLED_SIZE = 6
"""Rows up to which matrices are inverted, and multiplied, in written out operations that fuse."""
_ELIMINATED_SIZE = 32
"""Rows up to which matrices side by side are inverted sooner here than by a library."""


class Inertia(eqx.Module):
    """What makes up the matrix. Its rows are `d` for each node: 1 where no lever turns anything."""

    node: Float[Array, " N"]
    """kg"""
    stiff: Float[Array, " E"]
    """kg; of each edge."""
    geometry: Geometry

    @property
    def size(self) -> int:
        """d, rows a node."""
        return self.geometry.contact_jacobian.shape[-1]

    def __call__(self, x: Float[Array, "N d c"]) -> Float[Array, "N d c"]:
        """The product with c vectors."""
        return self.node[:, None, None] * x + to_nodes(
            self.stiff[:, None, None] * along_edges(x, self.geometry), self.geometry, x.shape[0]
        )


class Solved(eqx.Module):
    """What a step needs of the inverse."""

    solution: Float[Array, "N d c"]
    """Its products with c vectors."""
    own: Float[Array, " N"]
    """Its diagonal, the mean over a node's rows; 1/kg."""


def along_edges(x: Float[Array, "N d c"], geometry: Geometry) -> Float[Array, "E d c"]:
    """J x: of each edge's second end against its first, where they meet."""
    lever = geometry.contact_jacobian
    first, second = x[geometry.first], x[geometry.second]
    if lever.shape[-1] == 1:
        return second - first
    return jnp.einsum("eij,ejc->eic", lever[1], second) - jnp.einsum(
        "eij,ejc->eic", lever[0], first
    )


def to_nodes(on_edges: Float[Array, "E d c"], geometry: Geometry, count: int) -> Array:
    """J^T of what is on the edges, [N, d, c]."""
    lever, ends = geometry.contact_jacobian, jnp.stack([geometry.first, geometry.second])
    arriving = jnp.stack([-on_edges, on_edges])
    if lever.shape[-1] > 1:
        arriving = jnp.einsum("seji,sejc->seic", lever, arriving)
    return sum_at_nodes(arriving, ends, count)


def solve_dense(inertia: Inertia, vectors: Float[Array, "N d c"]) -> Solved:
    """By the inverse of the whole matrix."""
    count, size = inertia.node.shape[0], inertia.size
    jacobian = _jacobian(inertia.geometry, count)
    stiff, node = jnp.repeat(inertia.stiff, size), jnp.repeat(inertia.node, size)
    matrix = product(jacobian.T, stiff[:, None] * jacobian) + jnp.diag(node)
    inverse = _whole_inverse(matrix)
    solution = product(inverse, vectors.reshape(count * size, -1)).reshape(vectors.shape)
    own = jnp.mean(jnp.diagonal(inverse).reshape(count, size), axis=1)
    return Solved(solution, own)


def product(one: Float[Array, "n m"], other: Float[Array, "m c"]) -> Float[Array, "n c"]:
    """The matrix product; of small ones as a sum, which fuses with what is around it."""
    if max(one.shape) > _UNROLLED_SIZE:
        return one @ other
    return jnp.sum(one[:, :, None] * other[None], axis=1)


def _jacobian(geometry: Geometry, count: int) -> Float[Array, "Ed Nd"]:
    """From all velocities to the relative velocities along all edges."""
    lever = geometry.contact_jacobian
    size = lever.shape[-1]
    first, second = geometry.ends(count)
    blocks = second[:, None, :, None] * lever[1][:, :, None, :]
    blocks = blocks - first[:, None, :, None] * lever[0][:, :, None, :]
    return blocks.reshape(-1, count * size)


def solve_block_diagonal(
    inertia: Inertia, vectors: Float[Array, "N d c"], group_capacity: int
) -> Solved:
    """By the inverses of the groups. NaN where one has more nodes than `group_capacity`."""
    fixed = jax.lax.stop_gradient(inertia)
    count, size = inertia.node.shape[0], inertia.size
    ends = jnp.stack([inertia.geometry.first, inertia.geometry.second])
    groups = find_groups(fixed.stiff > 0, ends, count)
    blocks = jnp.where(
        groups.largest <= group_capacity, _blocks(fixed, groups, group_capacity), jnp.nan
    )
    rows = size * jnp.minimum(groups.largest, group_capacity)
    inverse = spd_inverse(blocks, rows).reshape(count, group_capacity, size, group_capacity, size)
    row = groups.group * group_capacity + jnp.minimum(groups.slot, group_capacity - 1)

    def solve(_: object, right: Float[Array, "N d c"]) -> Float[Array, "N d c"]:
        inside = (
            jnp.zeros((count * group_capacity, *right.shape[1:]), right.dtype).at[row].set(right)
        )
        inside = inside.reshape(count, group_capacity * size, -1)
        flat = inverse.reshape(count, group_capacity * size, group_capacity * size)
        return (flat @ inside).reshape(count * group_capacity, *right.shape[1:])[row]

    solution = jax.lax.custom_linear_solve(inertia, vectors, solve, symmetric=True)
    own = _own(
        inertia.node, inertia.stiff, inertia.geometry.contact_jacobian, ends, groups, inverse
    )
    return Solved(solution, own)


def _blocks(inertia: Inertia, groups: Groups, group_capacity: int) -> Float[Array, "N s s"]:
    """Each group's part of the matrix, a row for each `Groups.group`; ones where nobody is."""
    count, size, geometry = inertia.node.shape[0], inertia.size, inertia.geometry
    first, second = geometry.first, geometry.second
    lever, stiff = geometry.contact_jacobian, inertia.stiff[:, None, None]
    nowhere = count * group_capacity * group_capacity

    def at(one: Int[Array, " m"], other: Int[Array, " m"]) -> Int[Array, " m"]:
        row, column = groups.slot[one], groups.slot[other]
        there = (groups.group[one] * group_capacity + row) * group_capacity + column
        return jnp.where((row < group_capacity) & (column < group_capacity), there, nowhere)

    each = jnp.eye(size, dtype=inertia.node.dtype)
    own = stiff * jnp.einsum("seji,sejk->seik", lever, lever)
    own = sum_at_nodes(own, jnp.stack([first, second]), count)
    own = own + inertia.node[:, None, None] * each
    cross = -stiff * jnp.einsum("eji,ejk->eik", lever[0], lever[1])
    joined = inertia.stiff > 0
    node = jnp.arange(count)
    empty = jnp.eye(group_capacity, dtype=each.dtype).reshape(-1, 1, 1) * each
    flat = jnp.tile(empty, (count, 1, 1)).at[at(node, node)].set(own, mode="drop")
    flat = flat.at[jnp.where(joined, at(first, second), nowhere)].add(cross, mode="drop")
    back = jnp.swapaxes(cross, 1, 2)
    flat = flat.at[jnp.where(joined, at(second, first), nowhere)].add(back, mode="drop")
    blocks = jnp.swapaxes(flat.reshape(count, group_capacity, group_capacity, size, size), 2, 3)
    return blocks.reshape(count, group_capacity * size, group_capacity * size)


def spd_inverse(
    matrix: Float[Array, "*B n n"], rows: Int[Array, ""] | int
) -> Float[Array, "*B n n"]:
    """Inverses of many small, symmetric positive definite matrices, side by side.

    Only the first `rows` of a matrix are other than the identity's.
    """
    return jax.lax.fori_loop(0, rows, _eliminated, matrix)


def _eliminated(pivot: Int[Array, ""] | int, matrix: Float[Array, "*B n n"]) -> Array:
    """One round of Gauss and Jordan; positive definite matrices need no exchange of rows."""
    index = jnp.arange(matrix.shape[-1])
    row = jax.lax.dynamic_slice_in_dim(matrix, pivot, 1, -2)
    column = jax.lax.dynamic_slice_in_dim(matrix, pivot, 1, -1)
    scale = 1.0 / jax.lax.dynamic_slice_in_dim(row, pivot, 1, -1)
    in_row, in_column = index[:, None] == pivot, index[None, :] == pivot
    rest = matrix - column * (row * scale)
    rest = jnp.where(in_row, row * scale, jnp.where(in_column, -column * scale, rest))
    return jnp.where(in_row & in_column, scale, rest)


@jax.custom_jvp
def _whole_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    size = matrix.shape[0]
    # Of scenes side by side, a library inverts one after the other.
    if size > _ELIMINATED_SIZE:
        return jnp.linalg.inv(matrix)
    if size > _UNROLLED_SIZE:
        return spd_inverse(matrix, size)
    for pivot in range(size):
        matrix = _eliminated(pivot, matrix)
    return matrix


@_whole_inverse.defjvp
def _whole_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _whole_inverse(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


@jax.custom_jvp
def _own(
    node: Float[Array, " N"],
    stiff: Float[Array, " E"],
    contact_jacobian: Float[Array, "2 E d d"],
    ends: Int[Array, "2 E"],
    groups: Groups,
    inverse: Float[Array, "N s d s d"],
) -> Float[Array, " N"]:
    """The diagonal of the inverse, from the groups' blocks of it."""
    blocks = inverse[groups.group, groups.slot, :, groups.slot, :]
    return jnp.trace(blocks, axis1=1, axis2=2) / blocks.shape[-1]


@_own.defjvp
def _own_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # With c a node's column of the inverse, its entry changes by -c^T dH c.
    _, _, _, ends, groups, inverse = primals

    def square(node: Array, stiff: Array, lever: Array) -> Float[Array, " N"]:
        """c^T H c of every node's own columns, which are zero outside of its group."""
        size = inverse.shape[2]
        inside = jnp.zeros(inverse.shape[:2], node.dtype).at[groups.group, groups.slot].set(node)
        total = jnp.einsum("gm,gmisk->gs", inside, inverse**2)
        # [2, E, d, s, d]: what columns of its group each end sees.
        seen = inverse[groups.group[ends], groups.slot[ends]]
        seen = jnp.einsum("teij,tejsk->teisk", lever, seen)
        same = groups.group[ends[0]] == groups.group[ends[1]]
        both = jnp.sum((seen[1] - seen[0]) ** 2, axis=(1, 3))
        alone = jnp.sum(seen**2, axis=(2, 4))
        split = jnp.stack([jnp.where(same[:, None], both, alone[0]), alone[1]])
        split = split.at[1].multiply(~same[:, None])
        total = total + sum_at_nodes(stiff[:, None] * split, groups.group[ends], inverse.shape[0])
        return total[groups.group, groups.slot] / size

    change = jax.jvp(square, primals[:3], tangents[:3])[1]
    return _own(*primals), -change
