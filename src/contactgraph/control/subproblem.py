"""The subproblem of a scene's active nodes, and the state that one passes to the next.

Everything runs on the host, in NumPy.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Motion
from contactgraph.control.mpc import MPCState
from contactgraph.control.mpc_step import LastObservation
from contactgraph.control.swept_bounds import SweptBounds
from contactgraph.data import edge_id, pair_indices
from contactgraph.model import ContactBelief, Nodes

_SMALLEST, _TIMES = 2, 3
_HARDLY_MORE = 1.5
_SMALL = 4
"""Largest number of nodes of a scene that is planned as a whole."""


def bucket_size(count: int, capacity: int) -> int:
    """The number of nodes that a step about ``count`` of them is compiled for.

    It is 2, 6, 18, … or the capacity, if that is hardly larger. Each size compiles one program.
    """
    size = _SMALLEST
    while size < count:
        size *= _TIMES
    return size if size * _HARDLY_MORE <= capacity else capacity


def required_nodes(nodes: Nodes, cost: QuadraticCost) -> np.ndarray:
    """[m] Nodes that are active wherever they are; in a small scene all nodes."""
    mask = np.asarray(nodes.mask)
    if cost.cost_node_ids is None or len(mask) <= _SMALL:
        return np.arange(len(mask))
    required = np.array(nodes.actuated)
    if nodes.anchor is not None:
        required |= np.isfinite(np.asarray(nodes.anchor)[:, 0])
    required[np.asarray(cost.cost_node_ids)] = True
    return np.flatnonzero(required & mask)


def padded(nodes: np.ndarray, size: int) -> np.ndarray:
    """[size] The nodes in their order, then -1."""
    return np.concatenate([np.sort(nodes), np.full(size - len(nodes), -1)]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class ActiveSetState(MPCState):
    """State between two control steps; nodes, cost and carry are about the active nodes."""

    scene: tuple[Nodes, QuadraticCost]
    """The whole scene's."""
    required: np.ndarray
    """[n] bool: active nodes that are so wherever they are."""
    inactive: np.ndarray
    """[r] Nodes of the scene that are not active."""
    last_motion: Motion
    """Of all nodes: the last observation that was finite."""


def active_part(
    scene: tuple[Nodes, QuadraticCost],
    node_ids: np.ndarray,
    required: np.ndarray,
    motion: Motion,
    carry: Any = None,
) -> ActiveSetState:
    """The part of a scene about ``node_ids`` [n], ascending and then -1 for padding.

    All nodes that the cost is about must be among them. ``required`` [m] are those that are active
    wherever they are; ``motion`` is of all nodes.
    """
    nodes, cost = scene
    mask = np.asarray(nodes.mask)
    own = scene
    if not np.array_equal(node_ids, np.arange(len(mask))):
        # All at once: a call for each array takes as long as a control step.
        size = 2 * motion[0].shape[1]
        own = jax.device_put((_nodes_of(nodes, node_ids), _cost_of(cost, node_ids, size)))
    return ActiveSetState(
        nodes=own[0],
        cost=own[1],
        node_ids=node_ids,
        carry=carry,
        scene=scene,
        required=np.isin(node_ids, required),
        inactive=np.setdiff1d(np.flatnonzero(mask), node_ids),
        last_motion=motion,
    )


def carried_over(state: ActiveSetState, new: ActiveSetState) -> ActiveSetState:
    """``new``, which is about other active nodes and before any step, with what ``state`` carries.

    Added nodes begin as last observed, and no force depends on them; ``new`` has the beliefs about
    their edges. Gives NumPy arrays, which a compiled step takes as they are.
    """
    slot = {node: index for index, node in enumerate(state.node_ids.tolist()) if node >= 0}
    node = np.array([slot.get(each, -1) for each in new.node_ids.tolist()])
    # Nodes keep their order, so the smaller slot still comes first.
    first, second = node[pair_indices(len(node))].T
    edge = np.where((first >= 0) & (second >= 0), edge_id(first, second), -1)

    def nodes(known: jax.Array, added: np.ndarray, axis: int = -2) -> Any:
        return _chosen(np.asarray(known), node, added, axis)

    def belief(known: ContactBelief, added: ContactBelief) -> ContactBelief:
        types, others = np.asarray(known.type_probability), np.asarray(added.type_probability)
        return ContactBelief(_chosen(types, edge, others, -2))

    carry, fresh = state.carry, new.carry.belief
    plan, last = carry.plan, carry.last
    position, velocity = (values[new.node_ids] for values in new.last_motion)
    motion = np.stack([position, velocity], axis=1)
    assert plan.swept is not None
    moved = replace(
        plan,
        states=nodes(plan.states, motion, -3),
        policy=replace(plan.policy, K=nodes(plan.policy.K, np.zeros_like(motion), -3)),
        beliefs=belief(plan.beliefs, fresh),
        node_ids=new.plan.node_ids,
        swept=SweptBounds(nodes(plan.swept.lower, position), nodes(plan.swept.upper, position)),
    )
    observed = LastObservation(
        position=nodes(last.position, np.where(carry.is_first, np.nan, position)),
        velocity=nodes(last.velocity, velocity),
        belief=belief(last.belief, fresh),
        motion_log_odds=_chosen(np.asarray(last.motion_log_odds), edge, np.zeros(1), -1),
        control=last.control,
    )
    return replace(
        new, carry=replace(carry, belief=belief(carry.belief, fresh), plan=moved, last=observed)
    )


def _nodes_of(nodes: Nodes, ids: np.ndarray) -> Nodes:
    real = ids >= 0
    first, second = ids[pair_indices(len(ids))].T
    exists = (first >= 0) & (second >= 0)
    edge = np.where(exists, edge_id(first, second), 0)
    anchor: Any = None
    if nodes.anchor is not None:
        anchors = np.asarray(nodes.anchor)
        anchor = np.where(real[:, None], anchors[ids], anchors.dtype.type(np.nan))
    actuated: Any = np.asarray(nodes.actuated)[ids] & real
    mask: Any = np.asarray(nodes.mask)[ids] & real
    candidate: Any = np.asarray(nodes.candidate)[edge] & exists
    return Nodes(actuated, mask, candidate, anchor)


def _cost_of(cost: QuadraticCost, ids: np.ndarray, size: int) -> QuadraticCost:
    """``size``: 2D, entries a node."""
    count = cost.goal.shape[-1] // size
    before = np.arange(count) if cost.cost_node_ids is None else np.asarray(cost.cost_node_ids)
    after: Any = np.searchsorted(ids[ids >= 0], before).astype(np.int32)
    rows, columns = _rows(before, size), _rows(after, size)
    Q, goal = np.asarray(cost.Q), np.asarray(cost.goal)
    part: Any = np.zeros((*Q.shape[:-2], len(ids) * size, len(ids) * size), Q.dtype)
    part[..., columns[:, None], columns] = Q[..., rows[:, None], rows]
    target: Any = np.zeros((*goal.shape[:-1], len(ids) * size), goal.dtype)
    target[..., columns] = goal[..., rows]
    return replace(cost, Q=part, goal=target, cost_node_ids=after)


def _rows(nodes: np.ndarray, size: int) -> np.ndarray:
    return (nodes[:, None] * size + np.arange(size)).ravel()


def _chosen(known: np.ndarray, index: np.ndarray, new: np.ndarray, axis: int) -> Any:
    """``known`` at ``index`` along ``axis``, a negative one; ``new`` where the index is -1."""
    kept = np.take(known, np.maximum(index, 0), axis)
    stays = (index >= 0).reshape(-1, *[1] * (-1 - axis))
    return np.where(stays, kept, new).astype(known.dtype)
