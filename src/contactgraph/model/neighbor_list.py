"""Lists of near pairs, made anew in every step: the cost is linear in the number of nodes."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.model.graph import Edges, numbered, pair_count, place

_MOST_NODES = 46_340
"""The pairs of more have places that 32 bits do not hold."""


class NeighborList(eqx.Module):
    """Only pairs that may come into reach within a step are edges of it.

    Found by cells: space is cut into cubes as long as the reach and twice the longest way of a
    node, so that who is near is in the same one or next to it. Of few nodes the distances of all
    pairs are found sooner. What such a list leaves out is out of reach, and inactive for sure, so
    predictions are those of all pairs. Sizes are fixed when a model is made; a step that needs more
    has no prediction but NaN. See `allocate_neighbor_list`.
    """

    max_edges: int = eqx.field(static=True)
    """Room for so many near pairs."""
    cell_capacity: int | None = eqx.field(static=True)
    """Room for so many nodes in a cell. None: no cells, all pairs are gone through."""
    group_capacity: int | None = eqx.field(static=True, default=16)
    """Room for so many nodes that hold each other, directly or through others. None: for all, who
    are then solved as one group: time grows with the cube of their number."""

    def __check_init__(self) -> None:
        for name in ("max_edges", "cell_capacity", "group_capacity"):
            size = getattr(self, name)
            if size is not None and size < 1:
                raise InvalidInputError(f"{name} must be at least 1, found {size}")

    def __call__(
        self,
        position: Float[Array, "N D"],
        way: Float[Array, " N"],
        mask: Bool[Array, " N"],
        far: float,
    ) -> Edges:
        """The pairs of a step in which no node goes farther than its `way` [m].

        `far` [m]: nodes that come no nearer have no edge; `mask`: False for nodes that take part
        in nothing. Raises `InvalidInputError` where there are more nodes than can be numbered.
        """
        position, way = jax.lax.stop_gradient((position, way))
        count = position.shape[0]
        if count > _MOST_NODES:
            raise InvalidInputError(f"lists are for at most {_MOST_NODES} nodes, found {count}")
        if self.cell_capacity is None:
            near = near_pairs(position, way, mask, far)
            # The places of the first, second, ... near pair; of none, that behind the last pair.
            until = jnp.cumsum(near)
            passed = until[None, :] <= jnp.arange(self.max_edges)[:, None]
            listed = jnp.sum(passed, axis=1, dtype=jnp.int32)
            return Edges(numbered(listed, count), listed, until[-1] <= self.max_edges)
        all_found = candidates(position, way, mask, far, self.cell_capacity)
        number, near = all_found.edge_id, all_found.near
        rank = jnp.cumsum(near, axis=1)
        before = jnp.cumsum(rank[:, -1])
        found = before[-1]
        # A candidate's place in the list; what is not near goes nowhere.
        slot = rank - 1 + (before - rank[:, -1])[:, None]
        slot = jnp.where(near, slot, self.max_edges)
        listed = jnp.full(self.max_edges, pair_count(count), number.dtype)
        listed = jnp.sort(listed.at[slot.reshape(-1)].set(number.reshape(-1), mode="drop"))
        fits = (all_found.fullest <= self.cell_capacity) & (found <= self.max_edges)
        return Edges(numbered(listed, count), listed, fits)


def edge_count(lists: NeighborList | None, node_count: int) -> int:
    """Edges of a step of so many nodes: as many as there is room for, or all pairs."""
    return pair_count(node_count) if lists is None else lists.max_edges


def travel_bound(
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    control_displacement: Float[Array, "N D"] | None,
    anchor: Float[Array, "N D"] | None,
    dt: float,
) -> Float[Array, " N"]:
    """How far from a node's position [m] any point of its body may be in a step of `dt` [s] where
    it is met: arguments as of `geometry`."""
    way = dt * jnp.linalg.norm(velocity, axis=-1)
    if control_displacement is not None:
        way = way + jnp.linalg.norm(control_displacement, axis=-1)
    if anchor is None:
        return way
    # A bar's far end is an arm's length from its middle, and twice as fast.
    arm = jnp.linalg.norm(position - anchor, axis=-1)
    return jnp.where(jnp.isfinite(arm), arm + 2.0 * way, way)


def near_pairs(
    position: Float[Array, "N D"], way: Float[Array, " N"], mask: Bool[Array, " N"], far: float
) -> Bool[Array, " all"]:
    """Which of all pairs may come into reach within the step; arguments as of `NeighborList`."""
    first, second = pair_indices(position.shape[0]).T
    apart = position[second] - position[first]
    near = jnp.sum(apart**2, axis=-1) < (far + way[first] + way[second]) ** 2
    return near & mask[first] & mask[second]


class Candidates(eqx.Module):
    """Pairs of nodes in the same cell or in adjacent ones, each once."""

    edge_id: Int[Array, "N C"]
    """The pairs' places in `pair_indices`' order."""
    near: Bool[Array, "N C"]
    """Whether there is such a pair, and its nodes may come into reach within the step."""
    fullest: Int[Array, ""]
    """How many nodes are in the fullest cell."""


def candidates(
    position: Float[Array, "N D"],
    way: Float[Array, " N"],
    mask: Bool[Array, " N"],
    far: float,
    cell_capacity: int,
) -> Candidates:
    """Pairs to choose from; of more than `cell_capacity` nodes in a cell, the others' are missing.

    Arguments as of `NeighborList`.
    """
    count, dimension = position.shape
    # Cells repeat after `side` of them: two that share a number are told apart by distance.
    side = max(4, int(np.ceil((2.0 * count) ** (1.0 / dimension))))
    cells = side**dimension
    length = far + 2.0 * jnp.max(jnp.where(mask, way, 0.0))
    corner = jnp.floor(position / length).astype(jnp.int32)
    stride = side ** np.arange(dimension, dtype=np.int32)
    cell = jnp.where(mask, jnp.mod(corner, side) @ stride, cells)

    order = jnp.argsort(cell).astype(jnp.int32)
    held = jnp.zeros(cells + 1, jnp.int32).at[cell].add(1)
    begin = jnp.cumsum(held) - held
    rank = jnp.arange(count, dtype=jnp.int32) - begin[cell[order]]
    slot = jnp.where(
        rank < cell_capacity, cell[order] * cell_capacity + rank, (cells + 1) * cell_capacity
    )
    # Nobody is node `count`.
    table = jnp.full((cells + 1) * cell_capacity, count, jnp.int32).at[slot].set(order, mode="drop")
    table = table.reshape(cells + 1, cell_capacity).at[cells].set(count)

    other_cell = jnp.mod(corner[:, None] + _half_around(dimension), side) @ stride
    other = table[other_cell].reshape(count, -1)
    node = jnp.arange(count, dtype=jnp.int32)[:, None]
    where = jnp.concatenate([position, way[:, None]], axis=1)
    there = where.at[other].get(mode="clip")
    apart = there[..., :dimension] - position[:, None]
    reach = far + way[:, None] + there[..., dimension]
    near = jnp.sum(apart**2, axis=-1) < reach**2
    near = near & (other < count) & mask[:, None]
    # The first of the cells is the node's own, in which each pair is met from both its ends.
    own = jnp.arange(other.shape[1]) < cell_capacity
    near = near & (~own | (other > node))
    return Candidates(place(node, other), near, jnp.max(held[:cells]))


def _half_around(dimension: int) -> np.ndarray:
    """[C, D] steps to the own cell, first, and to one of each two opposite adjacent cells."""
    around = np.array(list(itertools.product((0, 1, -1), repeat=dimension)), np.int32)
    opposite = [tuple(step) > tuple(-step) for step in around]
    return np.concatenate([around[:1], around[opposite]])
