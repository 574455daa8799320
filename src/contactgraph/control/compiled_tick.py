"""The tick, compiled: once for each room that nodes in play are given."""

import logging
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from contactgraph.control.measurement import Motion
from contactgraph.control.mpc_state import MPCState
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.tick import Controller

_log = logging.getLogger(__name__)
_Tree = TypeVar("_Tree")


class CompiledTick:
    """A `Controller` with compiled functions, on the nodes in play."""

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        # A flat tuple of arrays is dispatched faster than the tree they came from, and weights
        # that are arguments, not constants, are neither folded nor compiled in.
        dynamic, static = eqx.partition(controller, eqx.is_array)
        leaves, treedef = jax.tree.flatten(dynamic)
        self._weights = tuple(leaves)

        def rebuilt(weights: tuple) -> Controller:
            return eqx.combine(jax.tree.unflatten(treedef, weights), static)

        def tick(weights: tuple, *inputs: Any) -> tuple[Plan, MPCState]:
            return rebuilt(weights).tick(*inputs)

        def first_state(weights: tuple, *inputs: Any) -> MPCState:
            return rebuilt(weights).first_state(*inputs)

        def running(weights: tuple, state: MPCState, status: jax.Array) -> Plan:
            return replace(rebuilt(weights).running_plan(state), status=status)

        self._tick = jax.jit(tick)
        self._running = jax.jit(running)
        self._first_state = jax.jit(first_state)
        self._most = 0
        self._warm: set[tuple] = set()
        self.dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))

    def tick(
        self,
        state: MPCState,
        position: np.ndarray,
        velocity: np.ndarray,
        contact: np.ndarray,
        applied: np.ndarray,
        *,
        last_seen: Motion | None = None,
    ) -> tuple[Plan, MPCState]:
        """See `Controller.tick`; ``position``, … are of the nodes in play.

        ``last_seen``: of all nodes, to be remembered where only a part of them is in play.
        """
        inputs = position, velocity, contact, applied
        plan, after = self._tick(self._weights, _in_play(state), *inputs)
        if state.part is None:
            return plan, after
        return plan, replace(
            after,
            nodes=state.nodes,
            cost=state.cost,
            part=state.part,
            last_seen=last_seen,
        )

    def running(self, state: MPCState, status: PlanStatus) -> Plan:
        """The last plan from the present on, under this status."""
        return self._running(self._weights, _in_play(state), np.asarray(status, np.int32))

    def make_room(self, count: int) -> None:
        """Says so in the log where the coming tick compiles for more nodes in play than before."""
        if self._most and count > self._most:
            _log.warning(
                "compiling a tick for up to %d nodes in play; so far there was room for %d",
                count,
                self._most,
            )
        self._most = max(self._most, count)

    def warm_up(self, state: MPCState, *inputs: np.ndarray) -> None:
        """Compile for states like this one, where that has not been done."""
        leaves = jax.tree.leaves(_in_play(state))
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if shapes in self._warm:
            return
        self._warm.add(shapes)
        self.make_room(len(state.who))
        self.tick(state, *inputs)
        jax.block_until_ready(self.running(state, PlanStatus.LATE))

    def first_state(self, *inputs: Any) -> MPCState:
        """See `Controller.first_state`."""
        return self._first_state(self._weights, *inputs)

    def strongly_typed(self, values: _Tree) -> _Tree:
        """Every float of one type and none of them weak: else the second tick would compile
        again."""

        def typed(value: Any) -> np.ndarray:
            array = np.asarray(value)
            return array.astype(self.dtype) if np.issubdtype(array.dtype, np.floating) else array

        # Made by NumPy and moved: each `jax.numpy` call would compile a little program.
        return jax.device_put(jax.tree.map(typed, values))


def _in_play(state: MPCState) -> MPCState:
    """The state as the compiled functions take it, in which those in play are all there are."""
    part = state.part
    if part is None:
        return state
    return replace(state, nodes=part.nodes, cost=part.cost, part=None, last_seen=None)
