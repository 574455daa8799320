"""Neighbor lists: the near pairs of nodes alone are the edges of a step; sizes, and overflow."""

import dataclasses
import itertools
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import travel_bound
from contactgraph.bodies.graph import Edges, edge_nodes
from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import edge_id, pair_count, pair_indices
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.large_scenes.block_inverse import GroupsOf
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.step import StepModel

CELLS_FROM = 32
"""Nodes from which lists use cells, and coupled bodies are solved by groups."""

_MAX_SAMPLED_NODES = 100_000
"""Nodes of a dataset's states, evenly spread, from which capacities are chosen."""
_SPARE = 1.5
_MIN_SPARE = 4
"""Edges; training adds one more node to the recorded ones, which is near to some."""
_MAX_SHARE = 0.5
"""Of all pairs: with a smaller list a step is faster, for 6 nodes and more by measurement."""
_GROWTH = 4
_LENGTHS = 6
_LONGER = 0.25
"""Of the cutoff: the largest additional travel bound for which cells are large enough."""

_State = tuple[
    np.ndarray | Array, np.ndarray | Array, np.ndarray | Array, np.ndarray | Array | None
]
"""Position and velocity [N, D], mask [N], and anchor [N, D] or None."""

_log = logging.getLogger(__name__)
_Result = TypeVar("_Result")
_Model = TypeVar("_Model", bound=StepModel)
_MAX_NODES = 46_340
"""The pairs of more nodes have ids beyond 32 bits."""


def unordered_edge_id(one: Int[Array, " E"], other: Int[Array, " E"]) -> Int[Array, " E"]:
    """The id of the edge between two nodes, in either order."""
    return edge_id(jnp.minimum(one, other), jnp.maximum(one, other))


class NeighborList(eqx.Module):
    """Restricts the edges of a step to the pairs that may come within the cutoff during it.

    Pairs are searched in cells: space is divided into cubes as long as the cutoff plus twice the
    largest travel bound, so that near nodes are in the same cell or in adjacent ones. For few nodes
    it is faster to compute the distances of all pairs. Pairs that are not listed are beyond the
    cutoff and inactive with certainty, so predictions are those of all pairs. Capacities are fixed
    when a model is made; a step that exceeds one predicts NaN. See `allocate_neighbor_list`.
    """

    max_edges: int = eqx.field(static=True)
    """Most near pairs."""
    cell_capacity: int | None = eqx.field(static=True)
    """Most nodes in a cell. None: no cells; all pairs are searched."""
    group_capacity: int | None = eqx.field(static=True, default=16)
    """Most nodes that are coupled, directly or through others. None: no limit; all nodes are solved
    as one group, in time cubic in their number."""

    def __check_init__(self) -> None:
        for name in ("max_edges", "cell_capacity", "group_capacity"):
            size = getattr(self, name)
            if size is not None and size < 1:
                raise InvalidInputError(f"{name} must be at least 1, found {size}")

    def grown(self, factor: int) -> "NeighborList":
        """The same with as many times the capacity."""
        cells, groups = self.cell_capacity, self.group_capacity
        return NeighborList(
            max_edges=factor * self.max_edges,
            cell_capacity=None if cells is None else factor * cells,
            group_capacity=None if groups is None else factor * groups,
        )

    @property
    def groups(self) -> GroupsOf | None:
        """Groups of `group_capacity` nodes. None: all nodes are solved as one group."""
        return None if self.group_capacity is None else GroupsOf(self.group_capacity)

    def __call__(
        self,
        position: Float[Array, "N D"],
        bound: Float[Array, " N"],
        mask: Bool[Array, " N"],
        cutoff: float,
    ) -> Edges:
        """The pairs of a step in which each node moves at most its travel `bound` [m].

        Nodes that stay farther apart than `cutoff` [m] have no edge, nor have nodes outside the
        `mask`. Raises `InvalidInputError` where there are more nodes than 32-bit ids allow.
        """
        position, bound = jax.lax.stop_gradient((position, bound))
        count = position.shape[0]
        if count > _MAX_NODES:
            raise InvalidInputError(f"lists are for at most {_MAX_NODES} nodes, found {count}")
        if self.cell_capacity is None:
            near = near_pairs(position, bound, mask, cutoff)
            # The ids of the first, second, ... near pair; beyond the last one, that of no pair.
            total = jnp.cumsum(near)
            passed = total[None, :] <= jnp.arange(self.max_edges)[:, None]
            listed = jnp.sum(passed, axis=1, dtype=jnp.int32)
            return Edges(edge_nodes(listed, count), listed, total[-1] <= self.max_edges)
        found = cell_candidates(position, bound, mask, cutoff, self.cell_capacity)
        rank = jnp.cumsum(found.near, axis=1)
        total = jnp.cumsum(rank[:, -1])
        # The slot of a candidate in the list; candidates that are not near have none.
        slot = rank - 1 + (total - rank[:, -1])[:, None]
        slot = jnp.where(found.near, slot, self.max_edges).reshape(-1)
        listed = jnp.full(self.max_edges, pair_count(count), found.edge_id.dtype)
        listed = jnp.sort(listed.at[slot].set(found.edge_id.reshape(-1), mode="drop"))
        fits = (found.largest_cell <= self.cell_capacity) & (total[-1] <= self.max_edges)
        return Edges(edge_nodes(listed, count), listed, fits)


def near_pairs(
    position: Float[Array, "N D"],
    bound: Float[Array, " N"],
    mask: Bool[Array, " N"],
    cutoff: float,
) -> Bool[Array, " all"]:
    """Mask of the pairs that may come within the cutoff; arguments as of `NeighborList`."""
    first, second = pair_indices(position.shape[0]).T
    apart = position[second] - position[first]
    near = jnp.sum(apart**2, axis=-1) < (cutoff + bound[first] + bound[second]) ** 2
    return near & mask[first] & mask[second]


class CellCandidates(eqx.Module):
    """Pairs of nodes in the same cell or in adjacent ones, each once."""

    edge_id: Int[Array, "N C"]
    near: Bool[Array, "N C"]
    """Whether the pair exists, and its nodes may come within the cutoff."""
    largest_cell: Int[Array, ""]
    """Nodes in the fullest cell."""


def cell_candidates(
    position: Float[Array, "N D"],
    bound: Float[Array, " N"],
    mask: Bool[Array, " N"],
    cutoff: float,
    capacity: int,
) -> CellCandidates:
    """Candidates for near pairs; a cell of more than `capacity` nodes lacks the others.

    Arguments as of `NeighborList`.
    """
    count, dimension = position.shape
    # Cells repeat with period `side`: those that share an index differ in distance.
    side = max(4, int(np.ceil((2.0 * count) ** (1.0 / dimension))))
    cells = side**dimension
    length = cutoff + 2.0 * jnp.max(jnp.where(mask, bound, 0.0))
    corner = jax.vmap(_without_gaps, 1, 1)(jnp.floor(position / length).astype(jnp.int32))
    stride = side ** np.arange(dimension, dtype=np.int32)
    cell = jnp.where(mask, jnp.mod(corner, side) @ stride, cells)

    order = jnp.argsort(cell).astype(jnp.int32)
    occupancy = jnp.zeros(cells + 1, jnp.int32).at[cell].add(1)
    begin = jnp.cumsum(occupancy) - occupancy
    rank = jnp.arange(count, dtype=jnp.int32) - begin[cell[order]]
    slot = jnp.where(rank < capacity, cell[order] * capacity + rank, (cells + 1) * capacity)
    # Empty slots hold the index `count`, which is no node.
    table = jnp.full((cells + 1) * capacity, count, jnp.int32).at[slot].set(order, mode="drop")
    table = table.reshape(cells + 1, capacity).at[cells].set(count)

    other_cell = jnp.mod(corner[:, None] + _half_neighborhood(dimension), side) @ stride
    other = table[other_cell].reshape(count, -1)
    node = jnp.arange(count, dtype=jnp.int32)[:, None]
    gathered = jnp.concatenate([position, bound[:, None]], axis=1).at[other].get(mode="clip")
    apart = gathered[..., :dimension] - position[:, None]
    limit = cutoff + bound[:, None] + gathered[..., dimension]
    near = jnp.sum(apart**2, axis=-1) < limit**2
    near = near & (other < count) & mask[:, None]
    # The first of the cells is the node's own, in which each pair occurs from both of its nodes.
    own = jnp.arange(other.shape[1]) < capacity
    near = near & (~own | (other > node))
    return CellCandidates(unordered_edge_id(node, other), near, jnp.max(occupancy[:cells]))


def _without_gaps(corner: Int[Array, " N"]) -> Int[Array, " N"]:
    """Coordinates of cells, of which those that are adjacent stay so, and others become 2 apart.

    Without it, a scene whose spacing is a period of the cells has many nodes in each.
    """
    places = jnp.sort(corner)
    compact = jnp.cumsum(jnp.clip(jnp.diff(places, prepend=places[:1]), 0, 2))
    return compact[jnp.searchsorted(places, corner)]


def _half_neighborhood(dimension: int) -> np.ndarray:
    """[C, D] offsets of the own cell, first, and of one of each two opposite adjacent cells."""
    around = np.array(list(itertools.product((0, 1, -1), repeat=dimension)), np.int32)
    positive = [tuple(offset) > tuple(-offset) for offset in around]
    return np.concatenate([around[:1], around[positive]])


def allocate_neighbor_list(
    model: ContactDynamics,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    nodes: Nodes,
    spare: float = _SPARE,
    group_capacity: int | None = 16,
) -> ContactDynamics:
    """The model with a neighbor list whose capacities are `spare` times what this scene needs.

    Its predictions are those of `model`, but for rounding, as long as the scene does not become
    much denser or faster; then they are NaN, and the list must be allocated again.
    `group_capacity`: see `NeighborList`. Raises `InvalidInputError` where the model has no cutoff.
    """
    # Raises where the model has no cutoff, before that is used.
    listed = dataclasses.replace(model, neighbor_list=NeighborList(1, 1, group_capacity))
    max_edges, capacity = _cell_sizes(
        model, [(position, velocity, nodes.mask, nodes.anchor)], spare
    )
    return dataclasses.replace(
        listed, neighbor_list=NeighborList(max_edges, capacity, group_capacity)
    )


class ReallocatingModel(Generic[_Model]):
    """A model with a neighbor list where few pairs are near, reallocated once on overflow.

    A model that already has a list keeps it: its capacities are the limit. A model without a cutoff
    uses all pairs, and so does one that is no `ContactDynamics`, and one of few nodes whose list
    would need half of the pairs.
    """

    def __init__(self, model: _Model, dataset: Dataset) -> None:
        """`dataset`: recorded trajectories like those that are to be predicted."""
        self.given = self.model = model
        self._grown: _Model | None = None
        if not isinstance(model, ContactDynamics) or model.neighbor_list is not None:
            return
        if not math.isfinite(getattr(model.cutoff, "outer", math.inf)):
            return
        count = max(one.scene.node_count for one in dataset)
        if count < CELLS_FROM and _MAX_SHARE * pair_count(count) <= _MIN_SPARE:
            return  # A list would hold more, whatever is near.
        neighbor_list = _list_for(model, dataset, count)
        if count >= CELLS_FROM or neighbor_list.max_edges < _MAX_SHARE * pair_count(count):
            self.model = dataclasses.replace(model, neighbor_list=neighbor_list)
            self._grown = dataclasses.replace(model, neighbor_list=neighbor_list.grown(_GROWTH))

    def reallocate_on_overflow(
        self,
        predict: Callable[[_Model], _Result],
        finite: Callable[[_Result], bool],
    ) -> _Result:
        """The result of `predict`; where it is not `finite`, that with larger capacities.

        Capacities grow once for all calls: a result that is not finite with four times of them has
        another cause.
        """
        result = predict(self.model)
        if finite(result) or self._grown is None:
            return result
        _log.warning(
            "a prediction is not finite: the neighbor list grows to %d times its capacity and is "
            "compiled again",
            _GROWTH,
        )
        self.model, self._grown = self._grown, None
        return predict(self.model)


def _list_for(model: ContactDynamics, dataset: Dataset, count: int) -> NeighborList:
    """A list for scenes of `count` nodes as dense as the dataset's."""
    states = list(_states(dataset, count))
    if count >= CELLS_FROM:
        return NeighborList(*_cell_sizes(model, states, _SPARE))
    most = _most(model, states, lambda *at: jnp.sum(near_pairs(*at)))
    return NeighborList(max(int(np.ceil(_SPARE * most)), most + _MIN_SPARE), None, None)


def _cell_sizes(model: ContactDynamics, states: Sequence[_State], spare: float) -> tuple[int, int]:
    """`spare` times the most near pairs, and the most nodes in a cell, of these states."""

    def fullest(position: Array, bound: Array, mask: Array, cutoff: float) -> Array:
        # A faster node makes all cells longer, which divides the scene otherwise.
        longer = bound + jnp.linspace(0.0, _LONGER * cutoff, _LENGTHS)[:, None]
        each = jax.vmap(lambda bound: cell_candidates(position, bound, mask, cutoff, 1))(longer)
        return jnp.max(each.largest_cell)

    capacity = max(1, _most(model, states, fullest))
    search = partial(cell_candidates, capacity=capacity)
    pairs = _most(model, states, lambda *at: jnp.sum(search(*at).near))
    return int(np.ceil(spare * max(1, pairs))), int(np.ceil(spare * capacity))


def _most(model: ContactDynamics, states: Sequence[_State], count: Callable[..., Array]) -> int:
    """The largest ``count(position, bound, mask, cutoff)`` of these states; see `NeighborList`."""
    cutoff, dt = model.cutoff.outer, model.dt

    @jax.jit
    def counted(position: Array, velocity: Array, mask: Array, anchor: Array | None) -> Array:
        return count(position, travel_bound(position, velocity, None, anchor, dt), mask, cutoff)

    return max(int(counted(*state)) for state in states)


def _states(dataset: Dataset, count: int) -> Iterator[_State]:
    """States of the trajectories, padded to `count` nodes."""
    every = [(one, step) for one in dataset for step in range(one.steps + 1)]
    for one, step in every[:: -(-len(every) * count // _MAX_SAMPLED_NODES)]:
        padding = ((0, count - one.scene.node_count), (0, 0))
        anchor = None
        if one.scene.hinged.any():
            anchor = np.pad(one.scene.anchor, padding, constant_values=np.nan)
        mask = np.arange(count) < one.scene.node_count
        yield np.pad(one.position[step], padding), np.pad(one.velocity[step], padding), mask, anchor
