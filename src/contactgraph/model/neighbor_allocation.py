"""Neighbor lists sized for given scenes, and what a model guarantees of nodes that are not near."""

import dataclasses
import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data.dataset import Dataset
from contactgraph.data.graph import pair_count
from contactgraph.model.collision import SmoothCutoff
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.message_passing import EdgeNetwork
from contactgraph.model.neighbor_list import (
    NeighborList,
    cell_candidates,
    near_pairs,
    travel_bound,
)
from contactgraph.model.types import Nodes, StepModel

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
        self._may_grow = False
        if not isinstance(model, ContactDynamics) or model.neighbor_list is not None:
            return
        if not isinstance(model.cutoff, SmoothCutoff):
            return
        count = max(one.scene.node_count for one in dataset)
        if count < CELLS_FROM and _MAX_SHARE * pair_count(count) <= _MIN_SPARE:
            return  # A list would hold more, whatever is near.
        neighbor_list = _list_for(model, dataset, count)
        if count >= CELLS_FROM or neighbor_list.max_edges < _MAX_SHARE * pair_count(count):
            self._may_grow = True
            self.model = dataclasses.replace(model, neighbor_list=neighbor_list)

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
        if finite(result) or not self._may_grow:
            return result
        assert isinstance(self.model, ContactDynamics) and self.model.neighbor_list is not None
        self._may_grow = False
        before = self.model.neighbor_list
        cells, groups = before.cell_capacity, before.group_capacity
        after = NeighborList(
            max_edges=_GROWTH * before.max_edges,
            cell_capacity=None if cells is None else _GROWTH * cells,
            group_capacity=None if groups is None else _GROWTH * groups,
        )
        _log.warning(
            "a prediction is not finite: the neighbor list grows from %s to %s and is compiled "
            "again",
            before,
            after,
        )
        self.model = dataclasses.replace(self.model, neighbor_list=after)
        return predict(self.model)


def _list_for(model: ContactDynamics, dataset: Dataset, count: int) -> NeighborList:
    """A list for scenes of `count` nodes as dense as the dataset's."""
    states = list(_states(dataset, count))
    if count >= CELLS_FROM:
        return NeighborList(*_cell_sizes(model, states, _SPARE))
    cutoff, dt = _outer(model), model.dt

    @jax.jit
    def near(position: Array, velocity: Array, mask: Array, anchor: Array | None) -> Array:
        bound = travel_bound(position, velocity, None, anchor, dt)
        return jnp.sum(near_pairs(position, bound, mask, cutoff))

    most = max(int(near(*state)) for state in states)
    return NeighborList(max(int(np.ceil(_SPARE * most)), most + _MIN_SPARE), None, None)


def _cell_sizes(model: ContactDynamics, states: Iterable[_State], spare: float) -> tuple[int, int]:
    """`spare` times the most near pairs, and the most nodes in a cell, of these states."""
    cutoff, dt = _outer(model), model.dt
    # A faster node makes all cells longer, which divides the scene otherwise.
    longer = jnp.linspace(0.0, _LONGER * cutoff, _LENGTHS)

    @jax.jit
    def fullest(position: Array, velocity: Array, mask: Array, anchor: Array | None) -> Array:
        bound = travel_bound(position, velocity, None, anchor, dt) + longer[:, None]
        each = jax.vmap(lambda bound: cell_candidates(position, bound, mask, cutoff, 1))(bound)
        return jnp.max(each.largest_cell)

    @jax.jit
    def near(position: Array, velocity: Array, mask: Array, anchor: Array | None) -> Array:
        bound = travel_bound(position, velocity, None, anchor, dt)
        return jnp.sum(cell_candidates(position, bound, mask, cutoff, capacity).near)

    capacity = max(1, *(int(fullest(*state)) for state in states))
    pairs = max(1, *(int(near(*state)) for state in states))
    return int(np.ceil(spare * pairs)), int(np.ceil(spare * capacity))


def _outer(model: ContactDynamics) -> float:
    assert isinstance(model.cutoff, SmoothCutoff)
    return model.cutoff.outer


def _states(dataset: Dataset, count: int) -> Iterator[_State]:
    """States of the trajectories, padded to `count` nodes."""
    every = [(one, step) for one in dataset for step in range(one.steps + 1)]
    for one, step in every[:: -(-len(every) * count // _MAX_SAMPLED_NODES)]:
        padding = ((0, count - one.scene.node_count), (0, 0))
        anchor = None
        if one.scene.anchor is not None:
            anchor = np.pad(one.scene.anchor, padding, constant_values=np.nan)
        mask = np.arange(count) < one.scene.node_count
        yield np.pad(one.position[step], padding), np.pad(one.velocity[step], padding), mask, anchor


@dataclasses.dataclass(frozen=True)
class InteractionCutoff:
    """Guarantee of a model: nodes farther apart than ``distance`` do not affect each other.

    A node that touches nothing is decelerated only by the ground, and driven only by a control that
    acts on it.
    """

    distance: float
    """m, from centre to centre, or to a bar's middle line."""
    dt: float
    """Length of a step, s."""


def interaction_cutoff(model: object) -> InteractionCutoff | None:
    """The model's cutoff as a guarantee on predictions; None where it gives none.

    There is none without a cutoff of edges, with rounds of messages (an edge then depends on its
    nodes' other neighbours), where nodes may move by themselves (free matrices, the paper's head
    with its free equilibria), or where pins join far ones.
    """
    if not isinstance(model, ContactDynamics) or not isinstance(model.cutoff, SmoothCutoff):
        return None
    networks = [*model.local_dynamics.message_passing.networks, *model.inference.networks]
    if not all(isinstance(network, EdgeNetwork) for network in networks):
        return None
    head = getattr(model.local_dynamics, "head", None)
    if not isinstance(head, ContactLaw) or head.turn_length is not None:  # pins join far bodies
        return None
    return InteractionCutoff(model.cutoff.outer, model.dt)
