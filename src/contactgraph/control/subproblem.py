"""The active nodes of a plan, their subproblem, and the state that one passes to the next.

A node that no moving node approaches in a plan stays at rest and does not affect it. Nodes outside
a plan are not predicted. Their travel is bounded by that of the fastest of them, because the ground
slows them down and only they touch each other.

Everything runs on the host, in NumPy.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Motion, placed
from contactgraph.control.mpc_step import MPCCarry
from contactgraph.control.plan import Plan
from contactgraph.control.rollout import SweptBounds
from contactgraph.data import edge_id, pair_indices
from contactgraph.model import ContactBelief, ModelState, Nodes

_SMALLEST, _TIMES = 2, 3
_HARDLY_MORE = 1.5
_SMALL = 4
"""Largest number of nodes of a scene that is planned as a whole."""
_STILL = 0.005
"""Part of the cutoff: a node that moves by less in a plan has not been struck."""
_SLACK = 0.05
"""Part of the cutoff, added to it: springs and controls hardly move nodes without a contact."""
_LEAVES = 0.5
"""Part of the cutoff, beyond it, at which a node leaves the active set; it prevents flicker."""
_PADDING = {
    **dict.fromkeys(("actuated", "mask", "type_id", "static", "control_of", "log_mass"), 0),
    **dict.fromkeys(("half_size", "outlines"), 0),
    **dict.fromkeys(("anchor", "reach"), np.nan),
}
"""Properties of nodes, and their values for padding."""


def interaction_cutoff(model: object) -> float | None:
    """m; nodes farther apart do not affect each other, from centre to centre or to a bar's middle
    line, and one that touches nothing is decelerated only by the ground, and driven only by a
    control that acts on it. None where the model does not guarantee it.

    It does not without a cutoff of edges, with rounds of messages (an edge then depends on its
    nodes' other neighbours), where nodes may move by themselves (free matrices, the paper's head
    with its free equilibria), or where pins join far ones.
    """
    parts: Any = model
    outer = getattr(getattr(model, "cutoff", None), "outer", math.inf)
    if not math.isfinite(outer):
        return None
    passing = getattr(getattr(model, "local_dynamics", None), "message_passing", None)
    own = getattr(passing, "networks", ())
    if not own or any(getattr(each, "rounds", 1) for each in (*own, *parts.inference.networks)):
        return None
    head = getattr(parts.local_dynamics, "head", None)
    if getattr(head, "turn_length", 0.0) is not None:  # no law of contact, or pins join far bodies
        return None
    return float(outer)


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
    for wanted in (cost.cost_node_ids, *(each.wanted_nodes for each in cost.contacts)):
        required[np.asarray(wanted)] = True
    return np.flatnonzero(required & mask)


def padded(nodes: np.ndarray, size: int) -> np.ndarray:
    """[size] The nodes in their order, then -1."""
    return np.concatenate([np.sort(nodes), np.full(size - len(nodes), -1)]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class MPCState:
    """State between two control steps; nodes, cost and carry are about the active nodes."""

    nodes: Nodes
    cost: QuadraticCost
    node_ids: np.ndarray
    """[n] The active nodes of the scene, in their order; -1 for padding."""
    carry: Any
    """An `MPCCarry`; None before the first plan."""
    scene: tuple[Nodes, QuadraticCost]
    """The whole scene's."""
    required: np.ndarray
    """[n] bool: active nodes that are so wherever they are."""
    inactive: np.ndarray
    """[r] Nodes of the scene that are not active."""
    last_motion: Motion
    """Of all nodes: the last observation that was finite."""
    roomy: int = 0
    """Control steps for which fewer active nodes have been enough for a smaller size."""

    def __repr__(self) -> str:
        return f"MPCState(N={len(self.node_ids)}, {self.plan!r})"

    @property
    def plan(self) -> Plan:
        """The last plan, as of the last observation."""
        return self.carry.plan

    @property
    def belief(self) -> ContactBelief:
        """About the step that leads to the next observation, not yet corrected by its contacts."""
        return self.carry.filter.predicted

    @property
    def last(self) -> ModelState:
        """The last observation, and the belief about the step that led there."""
        return self.carry.filter.before


def active_part(
    scene: tuple[Nodes, QuadraticCost],
    node_ids: np.ndarray,
    required: np.ndarray,
    motion: Motion,
    carry: MPCCarry | None = None,
) -> MPCState:
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
        own = placed((_nodes_of(nodes, node_ids), _cost_of(cost, node_ids, size)))
    return MPCState(
        nodes=own[0],
        cost=own[1],
        node_ids=node_ids,
        carry=carry,
        scene=scene,
        required=np.isin(node_ids, required),
        inactive=np.setdiff1d(np.flatnonzero(mask), node_ids),
        last_motion=motion,
    )


def carried_over(state: MPCState, new: MPCState) -> MPCState:
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
        return jax.tree.map(
            lambda old, new: _chosen(np.asarray(old), edge, np.asarray(new), -new.ndim),
            known,
            added,
        )

    carry, fresh = state.carry, new.carry.filter.predicted
    plan, known = carry.plan, carry.filter
    last = known.before
    position, velocity = (values[new.node_ids] for values in new.last_motion)
    motion = np.stack([position, velocity], axis=1)
    moved = replace(
        plan,
        states=nodes(plan.states, motion, -3),
        policy=replace(plan.policy, K=nodes(plan.policy.K, np.zeros_like(motion), -3)),
        beliefs=belief(plan.beliefs, fresh),
        node_ids=new.plan.node_ids,
    )
    masses = known.masses, new.carry.filter.masses
    known = replace(
        known,
        before=replace(
            last,
            position=nodes(last.position, np.where(carry.is_first, np.nan, position)),
            velocity=nodes(last.velocity, velocity),
            belief=belief(last.belief, fresh),
        ),
        predicted=belief(known.predicted, fresh),
        masses=jax.tree.map(lambda old, begun: nodes(old, np.asarray(begun), -1), *masses),
    )
    return replace(new, carry=replace(carry, filter=known, plan=moved, swept=new.carry.swept))


def _nodes_of(nodes: Nodes, ids: np.ndarray) -> Nodes:
    first, second = ids[pair_indices(len(ids))].T
    exists = (first >= 0) & (second >= 0)
    candidate = np.asarray(nodes.candidate)[np.where(exists, edge_id(first, second), 0)] & exists
    parts: dict[str, Any] = {"candidate": candidate}
    for name, padding in _PADDING.items():
        values = getattr(nodes, name)
        if values is not None:
            chosen = np.asarray(values)[ids]
            real = (ids >= 0).reshape(-1, *[1] * (chosen.ndim - 1))
            parts[name] = np.where(real, chosen, chosen.dtype.type(padding))
    return nodes._replace(**parts)


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
    contacts = tuple(each.among(ids) for each in cost.contacts)
    return replace(cost, Q=part, goal=target, cost_node_ids=after, contacts=contacts)


def _rows(nodes: np.ndarray, size: int) -> np.ndarray:
    return (nodes[:, None] * size + np.arange(size)).ravel()


def _chosen(known: np.ndarray, index: np.ndarray, new: np.ndarray, axis: int) -> Any:
    """``known`` at ``index`` along ``axis``, a negative one; ``new`` where the index is -1."""
    kept = np.take(known, np.maximum(index, 0), axis)
    stays = (index >= 0).reshape(-1, *[1] * (-1 - axis))
    return np.where(stays, kept, new).astype(known.dtype)


@dataclass(frozen=True, eq=False)
class ActiveBounds:
    """The swept bounds of the active nodes, on the host."""

    swept: SweptBounds
    node_ids: np.ndarray
    """[n] of the active nodes; -1 for padding."""
    required: np.ndarray
    """[n] bool: nodes that are active wherever they are."""
    cutoff: float
    """m; see `interaction_cutoff`."""
    dt: float
    """s, of a step."""

    def nodes_to_add(self, others: np.ndarray, motion: Motion, cutoffs: float = 1.0) -> np.ndarray:
        """Those of the inactive nodes ``others`` [r] that should have been active, nearest first.

        ``motion`` is of all nodes. With more ``cutoffs`` than one, those follow that are as many
        cutoffs away, and may matter to the next plan.
        """
        position, speed = motion[0][others], _norm(motion[1][others])
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        horizon = len(lower)
        fast = self._is_fast(speed)
        radius = cutoffs * (1.0 + _SLACK) * self.cutoff
        drift = self.dt * np.max(speed, where=~fast, initial=0.0)
        # Most nodes are far from everything: one box around all bounds excludes them.
        margin = radius + drift * horizon
        low, high = lower.min(axis=(0, 1)) - margin, upper.max(axis=(0, 1)) + margin
        near = np.all((position > low) & (position < high), axis=1) & ~fast
        if not near.any():
            return others[fast]
        movers = np.flatnonzero(self._movers())
        point = position[near, None, None]
        outside = np.maximum(lower[:, movers] - point, point - upper[:, movers])
        radii = radius + drift * np.arange(1, horizon + 1)[:, None]
        margins = np.full(len(others), np.inf)
        margins[near] = np.min(_norm(np.maximum(outside, 0.0)) - radii, axis=(1, 2))
        margins[fast] = -np.inf
        added = np.flatnonzero(margins < 0.0)
        return others[added[np.argsort(margins[added], kind="stable")]]

    def nodes_to_keep(self, motion: Motion) -> np.ndarray:
        """Those of the active nodes that a moving one came near; ``motion`` is of all nodes."""
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        one_sided = lower[:, :, None] - upper[:, None]
        gap = np.maximum(np.maximum(one_sided, np.swapaxes(one_sided, 1, 2)), 0.0)
        near = np.any(_norm(gap) < (1.0 + _LEAVES) * self.cutoff, axis=0)
        movers, exists = self._movers(), self.node_ids >= 0
        kept = (self.required | self._is_fast(_norm(motion[1][self.node_ids]))) & exists
        for _ in self.node_ids:
            kept = kept | (near[kept & movers].any(axis=0) & exists)
        return self.node_ids[kept]

    def _movers(self) -> np.ndarray:
        """[n] All but the nodes that are active for being near, and at rest in the plan."""
        lower, upper = np.asarray(self.swept.lower), np.asarray(self.swept.upper)
        extent = upper.max(axis=0) - lower.min(axis=0)
        moves = np.max(extent, axis=-1) > _STILL * self.cutoff
        return (moves | self.required) & (self.node_ids >= 0)

    def _is_fast(self, speed: np.ndarray) -> np.ndarray:
        """Whether nodes of such a speed, m/s, travel farther in a plan than the cutoff."""
        horizon = len(np.asarray(self.swept.lower))
        return speed * self.dt * horizon > self.cutoff


def _norm(vector: np.ndarray) -> np.ndarray:
    # Observations may be huge: unlike a power, this overflows without a warning.
    return np.sqrt(np.einsum("...d,...d->...", vector, vector))
