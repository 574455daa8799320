"""A scene cut down to the nodes in play."""

import jax.numpy as jnp
import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.mpc_state import Part
from contactgraph.data.graph import pair_indices
from contactgraph.model import Nodes


def part_of(
    nodes: Nodes, cost: QuadraticCost, who: np.ndarray, always: np.ndarray, dimension: int
) -> Part:
    """The nodes ``who`` [n] of a whole scene, in their order and then -1 for padding.

    All nodes that the cost is about must be among them, and those who are ``always`` [m] in play.
    ``dimension``: D.
    """
    return Part(
        nodes=_nodes_of(nodes, who),
        cost=_cost_of(cost, who, 2 * dimension),
        always=np.isin(who, always),
        left_out=np.setdiff1d(np.flatnonzero(np.asarray(nodes.mask)), who),
        of=(nodes, cost),
    )


def _nodes_of(nodes: Nodes, who: np.ndarray) -> Nodes:
    real, there = who >= 0, np.maximum(who, 0)
    first, second = who[pair_indices(len(who))].T
    # The order of edges is that of `pair_indices`, whatever the number of nodes.
    edge = second * (second - 1) // 2 + first
    exists = (first >= 0) & (second >= 0)
    candidate = np.asarray(nodes.candidate)[np.where(exists, edge, 0)] & exists
    anchor = None if nodes.anchor is None else np.asarray(nodes.anchor)[there]
    return Nodes(
        actuated=jnp.asarray(np.asarray(nodes.actuated)[there] & real),
        mask=jnp.asarray(np.asarray(nodes.mask)[there] & real),
        candidate=jnp.asarray(candidate),
        anchor=None if anchor is None else jnp.asarray(np.where(real[:, None], anchor, np.nan)),
    )


def _cost_of(cost: QuadraticCost, who: np.ndarray, size: int) -> QuadraticCost:
    """``size``: 2D, entries a node."""
    everyone = np.arange(cost.goal.shape[-1] // size)
    involved = everyone if cost.involved is None else np.asarray(cost.involved)
    real = who[who >= 0]
    slots = np.searchsorted(real, involved)
    before, after = _rows(involved, size), _rows(slots, size)
    Q, goal = np.asarray(cost.Q), np.asarray(cost.goal)
    count = len(who) * size
    part = np.zeros((*Q.shape[:-2], count, count), Q.dtype)
    part[..., after[:, None], after] = Q[..., before[:, None], before]
    there = np.zeros((*goal.shape[:-1], count), goal.dtype)
    there[..., after] = goal[..., before]
    return QuadraticCost(
        Q=jnp.asarray(part),
        R=jnp.asarray(np.asarray(cost.R)),
        goal=jnp.asarray(there),
        terminal_weight=jnp.asarray(np.asarray(cost.terminal_weight)),
        involved=jnp.asarray(slots.astype(np.int32)),
    )


def _rows(nodes: np.ndarray, size: int) -> np.ndarray:
    return (nodes[:, None] * size + np.arange(size)).ravel()
