"""A scene cut down to the nodes in play, and what is known carried from some of them to others."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.mpc_state import Memory, MPCState, Part, Seen
from contactgraph.control.swept_bounds import SweptBounds
from contactgraph.data.graph import edge_index, pair_indices
from contactgraph.model import ContactBelief, Nodes


def part_of(
    nodes: Nodes, cost: QuadraticCost, who: np.ndarray, always: np.ndarray, dimension: int
) -> Part:
    """The nodes ``who`` [n] of a whole scene, in their order and then -1 for padding.

    All nodes that the cost is about must be among them, and those who are ``always`` [m] in play.
    ``dimension``: D.
    """
    mask = np.asarray(nodes.mask)
    own = nodes, cost
    if not np.array_equal(who, np.arange(len(mask))):
        # All at once: a call for each array takes as long as a tick.
        own = jax.device_put((_nodes_of(nodes, who), _cost_of(cost, who, 2 * dimension)))
    return Part(
        who=who,
        nodes=own[0],
        cost=own[1],
        always=np.isin(who, always),
        left_out=np.setdiff1d(np.flatnonzero(mask), who),
        of=(nodes, cost),
    )


def carried_over(state: MPCState, part: Part, new: Memory) -> MPCState:
    """The state about another ``part`` of its scene.

    Newcomers begin where they were last seen, at rest or going on as they did then, and are no
    reason for any force; ``new``, as of then, has the beliefs about their edges. Runs on the host.
    """
    known = state.memory
    assert known.swept is not None and new.swept is not None
    move = _Move(state.who, part.who)
    position, velocity = (values[part.who] for values in state.last_seen)
    motion = np.stack([position, velocity], axis=1)
    seen, plan = known.seen, known.plan
    memory = Memory(
        belief=move.belief(known.belief, new.belief),
        plan=replace(
            plan,
            states=move.stacked(plan.states, motion),
            policy=replace(plan.policy, K=move.stacked(plan.policy.K, np.zeros_like(motion))),
            beliefs=move.belief(plan.beliefs, new.belief),
            who=new.plan.who,
        ),
        steps_since_plan=known.steps_since_plan,
        seen=Seen(
            position=move.nodes(seen.position, np.where(known.fresh, np.nan, position)),
            velocity=move.nodes(seen.velocity, velocity),
            belief=move.belief(seen.belief, new.belief),
            told=move.edges(seen.told, np.zeros(1)),
            control=seen.control,
        ),
        fresh=known.fresh,
        swept=SweptBounds(
            move.nodes(known.swept.lower, position), move.nodes(known.swept.upper, position)
        ),
    )
    return replace(state, part=part, memory=memory)


def _nodes_of(nodes: Nodes, who: np.ndarray) -> Nodes:
    real = who >= 0
    first, second = who[pair_indices(len(who))].T
    exists = (first >= 0) & (second >= 0)
    edge = np.where(exists, edge_index(first, second), 0)
    anchor = None
    if nodes.anchor is not None:
        anchors = np.asarray(nodes.anchor)
        anchor = np.where(real[:, None], anchors[who], anchors.dtype.type(np.nan))
    return Nodes(
        actuated=np.asarray(nodes.actuated)[who] & real,
        mask=np.asarray(nodes.mask)[who] & real,
        candidate=np.asarray(nodes.candidate)[edge] & exists,
        anchor=anchor,
    )


def _cost_of(cost: QuadraticCost, who: np.ndarray, size: int) -> QuadraticCost:
    """``size``: 2D, entries a node."""
    everyone = np.arange(cost.goal.shape[-1] // size)
    involved = everyone if cost.involved is None else np.asarray(cost.involved)
    slots = np.searchsorted(who[who >= 0], involved)
    before, after = _rows(involved, size), _rows(slots, size)
    Q, goal = np.asarray(cost.Q), np.asarray(cost.goal)
    count = len(who) * size
    part: Any = np.zeros((*Q.shape[:-2], count, count), Q.dtype)
    part[..., after[:, None], after] = Q[..., before[:, None], before]
    there: Any = np.zeros((*goal.shape[:-1], count), goal.dtype)
    there[..., after] = goal[..., before]
    own: Any = slots.astype(np.int32)
    return replace(cost, Q=part, goal=there, involved=own)


def _rows(nodes: np.ndarray, size: int) -> np.ndarray:
    return (nodes[:, None] * size + np.arange(size)).ravel()


class _Move:
    """Where what is known of nodes and edges goes when others are in play.

    Gives NumPy arrays, which a compiled tick takes as they are, and sooner than if they were moved.
    """

    def __init__(self, before: np.ndarray, after: np.ndarray) -> None:
        """Nodes in play, in their order and then -1 for padding: [m] and [n]."""
        slot = {node: index for index, node in enumerate(before.tolist()) if node >= 0}
        self._node = np.array([slot.get(node, -1) for node in after.tolist()])
        # Nodes keep their order, so the smaller slot still comes first.
        first, second = self._node[pair_indices(len(after))].T
        stays = (first >= 0) & (second >= 0)
        self._edge = np.where(stays, edge_index(first, second), -1)

    def nodes(self, known: jax.Array, new: np.ndarray) -> Any:
        """``known`` […, m, D] and, of newcomers, ``new`` [n, D]."""
        return _chosen(np.asarray(known), self._node, new, -2)

    def stacked(self, known: jax.Array, new: np.ndarray) -> Any:
        """``known`` […, 2mD], in `stack_state`'s order, and of newcomers ``new`` [n, 2, D]."""
        by_node = np.asarray(known).reshape(*known.shape[:-1], -1, *new.shape[1:])
        chosen = _chosen(by_node, self._node, new, -3)
        return chosen.reshape(*known.shape[:-1], -1)

    def edges(self, known: jax.Array, new: np.ndarray) -> Any:
        """``known`` [e] and, where an edge has a newcomer, ``new`` [1]."""
        return _chosen(np.asarray(known), self._edge, new, -1)

    def belief(self, known: ContactBelief, new: ContactBelief) -> ContactBelief:
        """``known`` […, e, K] and, where an edge has a newcomer, ``new`` [e, K]."""
        types, others = np.asarray(known.type_probability), np.asarray(new.type_probability)
        return ContactBelief(_chosen(types, self._edge, others, -2))


def _chosen(known: np.ndarray, index: np.ndarray, new: np.ndarray, axis: int) -> Any:
    """``known`` at ``index`` along ``axis``, a negative one; ``new`` where the index is -1."""
    kept = np.take(known, np.maximum(index, 0), axis)
    stays = (index >= 0).reshape(-1, *[1] * (-1 - axis))
    return np.where(stays, kept, new).astype(known.dtype)
