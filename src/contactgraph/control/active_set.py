"""Model predictive control about the active nodes of a scene alone.

A node is always active if the control acts on it, the cost depends on it, it is hinged (its body
extends beyond the node), or it is fast enough to arrive from any distance. Other nodes become
active if the plan comes near them (`SweptBounds`), and the plan is then made again.
"""

import logging
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.host import Measured, Observation
from contactgraph.control.mpc import MPC
from contactgraph.control.plan import PlanStatus
from contactgraph.control.subproblem import (
    ActiveBounds,
    MPCState,
    active_part,
    bucket_size,
    carried_over,
    interaction_cutoff,
    padded,
    required_nodes,
)
from contactgraph.data import InvalidInputError
from contactgraph.model import Nodes

_SPARE = 10.0
"""Cutoffs within which nodes take slots that would stay empty."""
_PATIENCE = 3
"""Control steps for which nodes stay: a step that adds them again runs twice."""
_log = logging.getLogger(__name__)


class ActiveSetMPC(MPC):
    """An `MPC` in scenes of many nodes, with any planner: it plans about the active nodes alone.

    It applies to models whose edges have a cutoff (`interaction_cutoff`); with others all nodes
    are active. If the plan of a control step comes near inactive nodes, these become active and
    the step is repeated from its start: no plan passes through a body that it does not know of.
    Nodes leave four steps after they may.

    `reset` compiles for up to ``ready`` active nodes. More of them recompile once for up to 54,
    162, … nodes, which is logged; with ``ready`` at the capacity of nodes a step never compiles.
    """

    def __init__(self, mpc: MPC, ready: int = 18) -> None:
        """Raises `InvalidInputError` where ``ready`` is below 1."""
        if ready < 1:
            raise InvalidInputError(f"ready must be at least 1, found {ready}")
        vars(self).update(vars(mpc))
        # Sensor rates by edge are about the scene as a whole.
        by_edge = np.ndim(self.config.sensor.false_alarm) + np.ndim(self.config.sensor.miss) > 0
        self._cutoff = None if by_edge else interaction_cutoff(self.config.model)
        if self._cutoff is not None:
            model: Any = self.config.model
            self.config = replace(self.config, swept_dt=model.dt)
            self._compile()
        self._ready = ready
        self._largest = 0
        self._compiled: set[tuple] = set()

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """As `MPC.reset`; also compiles for more active nodes."""
        scene = self.checked(nodes, cost)
        seen = self.measured(observation, scene)
        required, capacity = self._required(*scene), len(scene[0].mask)
        most = max(len(required), self._ready)
        sizes = {bucket_size(count, capacity) for count in range(len(required), most + 1)}
        for size in sorted(sizes, reverse=True):
            part = active_part(scene, padded(required, size), required, seen[:2])
            self._compile_part(part, seen)
        before, after = self._settled(self.first(part), seen)
        return replace(before, carry=replace(before.carry, plan=after.plan))

    def planned(self, state: MPCState, seen: Measured) -> MPCState:
        """See `MPC.planned`."""
        return self._settled(self._shrunk(state), seen)[1]

    def _settled(self, state: MPCState, seen: Measured) -> tuple[MPCState, MPCState]:
        """A control step about all nodes that matter: the states before and after it."""
        motion = seen[:2]
        known = bool(np.isfinite(motion[0]).all() and np.isfinite(motion[1]).all())
        if not known:  # The active nodes are unknown; the step gets a bad observation.
            unknown = np.full_like(seen.position, np.nan)
            seen = seen._replace(position=unknown, velocity=unknown)
        while True:
            after = self.advance(state, seen)
            if not known or self._cutoff is None:
                return state, after
            after = replace(after, last_motion=motion)
            if not len(state.inactive):
                return state, after
            bounds = self._bounds(after)
            missing = bounds.nodes_to_add(state.inactive, motion)
            if not len(missing):
                return state, after
            # Spare slots take the nodes that may matter next.
            inside = state.node_ids[state.node_ids >= 0]
            free = bucket_size(len(inside) + len(missing), len(motion[0])) - len(inside)
            near = bounds.nodes_to_add(state.inactive, motion, cutoffs=_SPARE)
            state = self._with_active(state, np.concatenate([inside, near[:free]]))

    def _bounds(self, state: MPCState) -> ActiveBounds:
        assert self._cutoff is not None and self.config.swept_dt is not None
        cutoff = max([self._cutoff, *(each.reach for each in state.scene[1].contacts)])
        swept, dt = state.carry.swept, self.config.swept_dt
        return ActiveBounds(swept, state.node_ids, state.required, cutoff, dt)

    def _shrunk(self, state: MPCState) -> MPCState:
        """About fewer nodes, where the last step's rollouts show that a smaller size is enough."""
        capacity, size = len(state.last_motion[0]), len(state.node_ids)
        if bucket_size(int(np.sum(state.required)), capacity) >= size:
            return state
        kept = self._bounds(state).nodes_to_keep(state.last_motion)
        if bucket_size(len(kept), capacity) >= size:
            return replace(state, roomy=0)
        if state.roomy < _PATIENCE:
            return replace(state, roomy=state.roomy + 1)
        return self._with_active(state, kept)

    def in_scene(self, state: MPCState, scene: tuple[Nodes, QuadraticCost]) -> MPCState:
        """With the nodes active that these nodes or this cost require."""
        required = self._required(*scene)
        before = np.intersect1d(state.node_ids, np.flatnonzero(np.asarray(scene[0].mask)))
        inside = np.union1d(before, required)
        return self._with_active(state, inside, scene, required)

    def _with_active(
        self,
        state: MPCState,
        inside: np.ndarray,
        scene: tuple[Nodes, QuadraticCost] | None = None,
        required: np.ndarray | None = None,
    ) -> MPCState:
        """The state with the nodes ``inside`` active; in another scene, where one is given."""
        ids = padded(inside, bucket_size(len(inside), len(state.last_motion[0])))
        required = state.node_ids[state.required] if required is None else required
        part = active_part(scene or state.scene, ids, required, state.last_motion, state.carry)
        if np.array_equal(ids, state.node_ids):
            return part
        self._announce(len(ids))
        return carried_over(state, self.first(part))

    def _compile_part(self, part: MPCState, seen: Measured) -> None:
        """Compiles the step for these shapes, unless that was done before."""
        leaves = jax.tree.leaves((part.nodes, part.cost))
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if shapes in self._compiled:
            return
        self._compiled.add(shapes)
        self._announce(len(part.node_ids))
        state = self.first(part)
        after = self.advance(state, seen)
        jax.block_until_ready(after.plan)
        if self.deadline is not None:
            self.answer(0.0, state, after, PlanStatus.DEADLINE_MISSED)

    def _announce(self, count: int) -> None:
        if self._largest and count > self._largest:
            _log.warning(
                "compiling a control step for up to %d active nodes; so far there was room for %d",
                count,
                self._largest,
            )
        self._largest = max(self._largest, count)

    def _required(self, nodes: Nodes, cost: QuadraticCost) -> np.ndarray:
        """[m] Nodes that are active wherever they are."""
        return np.arange(len(nodes.mask)) if self._cutoff is None else required_nodes(nodes, cost)
