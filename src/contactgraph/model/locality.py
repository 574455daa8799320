"""Models for large scenes: the same ones, with room for the near pairs of such scenes."""

import dataclasses
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data.dataset import Dataset
from contactgraph.model.contact_belief import SmoothCutoff
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import AllEdges
from contactgraph.model.graph import pair_count
from contactgraph.model.heads import CoupledHead
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.message_passing import EdgeNetwork
from contactgraph.model.neighbor_list import (
    NeighborList,
    candidates,
    near_pairs,
    travel_bound,
)
from contactgraph.model.types import Nodes, StepModel

CELLS_FROM = 32
"""Nodes from which lists are made by cells, and what holds together is solved by groups."""

_LOOKED_AT = 100_000
"""Nodes of a dataset's states, evenly spread, that say how much room its scenes need."""
_SPARE = 1.5
_LEAST_SPARE = 4
"""Edges: one more node, as training places it among the recorded ones, is near to some."""
_WORTH = 0.5
"""Of all pairs: with less room than that a step with lists is the faster one, of 6 nodes and more
by measurement."""
_GROWTH = 4

_log = logging.getLogger(__name__)
_Result = TypeVar("_Result")
_Model = TypeVar("_Model", bound=StepModel)


@dataclasses.dataclass(frozen=True)
class _Seen:
    """One state of a scene: position and velocity [N, D], which nodes exist [N], hinges [N, D]."""

    position: Array | np.ndarray
    velocity: Array | np.ndarray
    mask: Array | np.ndarray
    anchor: Array | np.ndarray | None


def allocate_neighbor_list(
    model: ContactDynamics,
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    nodes: Nodes,
    spare: float = _SPARE,
    group_capacity: int | None = 16,
) -> ContactDynamics:
    """The model with lists that have room for `spare` times what this scene needs.

    Its predictions are those of `model`, but for rounding, as long as the scene does not get much
    denser or faster; then they are NaN, and lists must be made anew. `group`: see
    `NeighborList`. Raises `InvalidInputError` where the model's reach has no end.
    """
    # Refuses what has no end before that is asked for.
    listed = dataclasses.replace(model, neighbor_list=NeighborList(1, 1, group_capacity))
    edges, cell = _room(model, [_Seen(position, velocity, nodes.mask, nodes.anchor)], spare)
    return dataclasses.replace(listed, neighbor_list=NeighborList(edges, cell, group_capacity))


class ReallocatingModel(Generic[_Model]):
    """A model with lists where few pairs are near, whose room grows once where it is too small.

    A model that has lists already keeps to them: the room it was given is the limit. A model
    without end to its reach looks at all pairs as ever, and so does one that is no
    `ContactDynamics`, and of few nodes any whose lists would need room for half of the pairs.
    """

    def __init__(self, model: _Model, dataset: Dataset) -> None:
        """`dataset`: recorded runs like those that are to be predicted."""
        self.given = self.model = model
        self._may_grow = False
        if not isinstance(model, ContactDynamics) or model.neighbor_list is not None:
            return
        if not isinstance(model.cutoff, SmoothCutoff):
            return
        count = max(run.scene.node_count for run in dataset)
        if count < CELLS_FROM and _WORTH * pair_count(count) <= _LEAST_SPARE:
            return  # Whatever is near.
        lists = _lists_for(model, dataset, count)
        if count >= CELLS_FROM or lists.max_edges < _WORTH * pair_count(count):
            self._may_grow = True
            self.model = dataclasses.replace(model, neighbor_list=lists)

    def reallocate_on_overflow(
        self,
        predict: Callable[[_Model], _Result],
        finite: Callable[[_Result], bool],
    ) -> _Result:
        """What `predict` makes of the model; where that is not `finite`, of one with more room.

        Room grows once for all calls: what is not finite with four times of it is so for another
        reason.
        """
        found = predict(self.model)
        if finite(found) or not self._may_grow:
            return found
        assert isinstance(self.model, ContactDynamics) and self.model.neighbor_list is not None
        self._may_grow = False
        before = self.model.neighbor_list
        after = NeighborList(
            max_edges=_GROWTH * before.max_edges,
            cell_capacity=None if before.cell_capacity is None else _GROWTH * before.cell_capacity,
            group_capacity=None
            if before.group_capacity is None
            else _GROWTH * before.group_capacity,
        )
        _log.warning(
            "a prediction is not finite: lists of near pairs grow from %s to %s, compiled anew",
            before,
            after,
        )
        self.model = dataclasses.replace(self.model, neighbor_list=after)
        return predict(self.model)


def _lists_for(model: ContactDynamics, dataset: Dataset, count: int) -> NeighborList:
    """Lists for scenes of `count` nodes as crowded as the dataset's."""
    states = list(_states(dataset, count))
    if count >= CELLS_FROM:
        edges, cell = _room(model, states, _SPARE)
        return NeighborList(edges, cell)
    assert isinstance(model.cutoff, SmoothCutoff)
    far, dt = model.cutoff.outer, model.dt

    @jax.jit
    def found(position: Array, velocity: Array, mask: Array, anchor: Array | None) -> Array:
        way = travel_bound(position, velocity, None, anchor, dt)
        return jnp.sum(near_pairs(position, way, mask, far))

    near = max(int(found(s.position, s.velocity, s.mask, s.anchor)) for s in states)
    return NeighborList(max(int(np.ceil(_SPARE * near)), near + _LEAST_SPARE), None, None)


def _room(model: ContactDynamics, states: Iterable[_Seen], spare: float) -> tuple[int, int]:
    """Room for `spare` times the most near pairs, and the most nodes in a cell, of these states."""
    assert isinstance(model.cutoff, SmoothCutoff)
    far, dt = model.cutoff.outer, model.dt

    @partial(jax.jit, static_argnums=4)
    def needed(
        position: Array, velocity: Array, mask: Array, anchor: Array | None, cell_capacity: int
    ) -> tuple[Array, Array]:
        way = travel_bound(position, velocity, None, anchor, dt)
        found = candidates(position, way, mask, far, cell_capacity)
        return jnp.sum(found.near), found.fullest

    def most(cell_capacity: int) -> tuple[int, int]:
        sizes = [needed(s.position, s.velocity, s.mask, s.anchor, cell_capacity) for s in states]
        near, fullest = np.max(np.asarray(sizes), axis=0)
        return max(1, int(near)), max(1, int(fullest))

    fullest = most(1)[1]
    near = most(fullest)[0]
    return int(np.ceil(spare * near)), int(np.ceil(spare * fullest))


def _states(dataset: Dataset, count: int) -> Iterator[_Seen]:
    """States of the runs, padded to `count` nodes."""
    every = [(run, step) for run in dataset for step in range(run.steps + 1)]
    for run, step in every[:: -(-len(every) * count // _LOOKED_AT)]:
        more = ((0, count - run.scene.node_count), (0, 0))
        anchor = None
        if run.scene.anchor is not None:
            anchor = np.pad(run.scene.anchor, more, constant_values=np.nan)
        yield _Seen(
            position=np.pad(run.position[step], more),
            velocity=np.pad(run.velocity[step], more),
            mask=np.arange(count) < run.scene.node_count,
            anchor=anchor,
        )


_UNDRIVEN = 1e-3
"""1/kg; a control of 10 N then moves a bystander by 5 mm in a second."""


@dataclass(frozen=True)
class InteractionCutoff:
    """A model in which nodes that stay farther apart than ``far`` do not know of each other.

    And in which a node that touches nothing is slowed down by nothing but the ground, and driven
    by nothing but a control that acts on it.
    """

    distance: float
    """m, from centre to centre, or to a bar's middle line."""
    dt: float
    """s, of a step."""


def interaction_cutoff(model: object) -> InteractionCutoff | None:
    """None where it is not so, or nobody knows: any object can be planned with.

    Edges may have no end; what an edge does may depend on its ends' other neighbours (messages in
    rounds), so that there is no telling how far it reaches; nodes may move of themselves (free
    matrices, the paper's head with its free equilibria); or the model has not learned that controls
    do not act on bystanders.
    """
    if not isinstance(model, ContactDynamics) or not isinstance(model.cutoff, SmoothCutoff):
        return None
    dynamics, inference = model.local_dynamics, model.inference
    if not isinstance(dynamics, SpringMassDamperDynamics):
        return None
    networks = list(dynamics.message_passing.types)
    if not isinstance(inference, AllEdges):
        networks.append(inference.message_passing)
    if not all(isinstance(network, EdgeNetwork) for network in networks):
        return None
    head = dynamics.head
    # The first kind of node is neither actuated nor hinged.
    if not isinstance(head, CoupledHead) or not head.free_response[0] <= _UNDRIVEN:
        return None
    return InteractionCutoff(model.cutoff.outer, model.dt)
