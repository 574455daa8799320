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

_READY = 18
"""Active nodes that `reset` compiles for, where no limit is given."""
_SPARE, _SPARE_WITH_LIMIT = 10.0, 2.0
"""Cutoffs within which nodes take slots that would stay empty: they cost nothing there, but with a
limit they keep others out."""
_PATIENCE = 3
"""Control steps for which nodes stay without a limit: a step that adds them again runs twice."""
_NONE = np.zeros(0, int)
_log = logging.getLogger(__name__)


class ActiveSetMPC(MPC):
    """An `MPC` in scenes of many nodes, with any planner: it plans about the active nodes alone.

    It applies to models whose edges have a cutoff (`interaction_cutoff`); with others all nodes
    are active. If the plan of a control step comes near inactive nodes, these become active and
    the step is repeated from its start: no plan passes through a body that it does not know of.
    Nodes leave four steps after they may, with a limit one: the present step may already have run
    twice.

    `reset` compiles for up to 18 active nodes. More of them recompile once for up to 54, 162, …
    nodes, which is logged. With ``max_active_nodes`` a step never compiles: one that would need
    more active nodes gives the previous plan, shifted, as CAPACITY_EXCEEDED.
    """

    def __init__(self, mpc: MPC, max_active_nodes: int | None = None) -> None:
        """``max_active_nodes`` None: without a limit; raises `InvalidInputError` below 1."""
        if max_active_nodes is not None and max_active_nodes < 1:
            raise InvalidInputError(
                f"max_active_nodes must be at least 1, found {max_active_nodes}"
            )
        vars(self).update(vars(mpc))
        # Sensor rates by edge are about the scene as a whole.
        by_edge = np.ndim(self.config.sensor.false_alarm) + np.ndim(self.config.sensor.miss) > 0
        self._cutoff = None if by_edge else interaction_cutoff(self.config.model)
        if self._cutoff is not None:
            model: Any = self.config.model
            self.config = replace(self.config, swept_dt=model.dt)
            self._compile()
        self._max = max_active_nodes
        self._largest = 0
        self._compiled: set[tuple] = set()

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """As `MPC.reset`; also compiles for more active nodes, up to the limit or 18.

        Raises `InvalidInputError` where the scene needs more active nodes than the limit.
        """
        scene = self.checked(nodes, cost)
        seen = self.measured(observation, scene)
        required, capacity = self._required(*scene), len(scene[0].mask)
        most = max(len(required), self._max or _READY)
        sizes = {bucket_size(count, capacity) for count in range(len(required), most + 1)}
        for size in sorted(sizes, reverse=True):
            part = active_part(scene, padded(required, size), required, seen[:2])
            self._compile_part(part, seen)
        before, after, missing = self._settled(self.first(part), seen)
        self._check_limit(int(np.sum(before.node_ids >= 0)) + len(missing))
        return replace(before, carry=replace(before.carry, plan=after.plan))

    def planned(self, state: MPCState, seen: Measured) -> tuple[MPCState, PlanStatus | None]:
        """See `MPC.planned`."""
        _, after, missing = self._settled(self._shrunk(state), seen)
        return after, PlanStatus.CAPACITY_EXCEEDED if len(missing) else None

    def _settled(self, state: MPCState, seen: Measured) -> tuple[MPCState, MPCState, np.ndarray]:
        """A control step about all nodes that matter: the states before and after it, and the nodes
        that the limit keeps out."""
        motion = seen[:2]
        known = bool(np.isfinite(motion[0]).all() and np.isfinite(motion[1]).all())
        if not known:  # The active nodes are unknown; the step gets a bad observation.
            unknown = np.full_like(seen.position, np.nan)
            seen = seen._replace(position=unknown, velocity=unknown)
        while True:
            after = self.advance(state, seen)
            if not known or self._cutoff is None:
                return state, after, _NONE
            after = replace(after, last_motion=motion)
            if not len(state.inactive):
                return state, after, _NONE
            bounds = self._bounds(after)
            missing = bounds.nodes_to_add(state.inactive, motion)
            inside = state.node_ids[state.node_ids >= 0]
            free = len(missing) if self._max is None else max(0, self._max - len(inside))
            if not len(missing[:free]):
                return state, after, missing
            # Spare slots take the nodes that may matter next.
            reach = _SPARE if self._max is None else _SPARE_WITH_LIMIT
            size = bucket_size(len(inside) + len(missing[:free]), len(motion[0]))
            free = min(size, self._max or size) - len(inside)
            near = bounds.nodes_to_add(state.inactive, motion, cutoffs=reach)
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
        if self._max is None and state.roomy < _PATIENCE:
            return replace(state, roomy=state.roomy + 1)
        return self._with_active(state, kept)

    def in_scene(self, state: MPCState, scene: tuple[Nodes, QuadraticCost]) -> MPCState:
        """With the nodes active that these nodes or this cost require.

        Raises `InvalidInputError` where they are more than the limit.
        """
        required = self._required(*scene)
        before = np.intersect1d(state.node_ids, np.flatnonzero(np.asarray(scene[0].mask)))
        inside = np.union1d(before, required)
        if self._max is not None and len(inside) > self._max:
            inside = required  # Other nodes that matter are added again.
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
        if self._max is not None or self.deadline is not None:
            self.answer(0.0, state, after, PlanStatus.CAPACITY_EXCEEDED)

    def _announce(self, count: int) -> None:
        if self._largest and count > self._largest:
            _log.warning(
                "compiling a control step for up to %d active nodes; so far there was room for %d",
                count,
                self._largest,
            )
        self._largest = max(self._largest, count)

    def _required(self, nodes: Nodes, cost: QuadraticCost) -> np.ndarray:
        """[m] Nodes that are active wherever they are; raises where the limit is lower."""
        if self._cutoff is None:
            required = np.arange(len(nodes.mask))
        else:
            required = required_nodes(nodes, cost)
        self._check_limit(len(required))
        return required

    def _check_limit(self, count: int) -> None:
        if self._max is not None and count > self._max:
            raise InvalidInputError(
                f"max_active_nodes must be at least {count} for this scene, found {self._max}"
            )
