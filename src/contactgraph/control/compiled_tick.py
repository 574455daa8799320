"""The tick, compiled: once for each room that nodes in play are given."""

import logging
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from contactgraph.control.host import Motion
from contactgraph.control.mpc_state import Memory, Part
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.tick import Controller

_log = logging.getLogger(__name__)
_Tree = TypeVar("_Tree")


class CompiledTick:
    """A `Controller` with compiled functions, on the nodes in play."""

    def __init__(self, controller: Controller, falls_back: bool) -> None:
        """``falls_back``: whether `running` may be asked for; if so, it is compiled for, too."""
        self.controller, self._falls_back = controller, falls_back
        # A flat tuple of arrays is dispatched faster than the tree they came from, and weights
        # that are arguments, not constants, are neither folded nor compiled in.
        dynamic, static = eqx.partition(controller, eqx.is_array)
        leaves, treedef = jax.tree.flatten(dynamic)
        self._weights = tuple(leaves)

        def rebuilt(weights: tuple) -> Controller:
            return eqx.combine(jax.tree.unflatten(treedef, weights), static)

        def first(weights: tuple, *inputs: Any) -> Memory:
            return rebuilt(weights).first_memory(*inputs)

        def tick(weights: tuple, *inputs: Any) -> Memory:
            return rebuilt(weights).tick(*inputs)

        def running(weights: tuple, memory: Memory, status: jax.Array) -> Plan:
            plan = rebuilt(weights).running_plan(memory)
            return eqx.tree_at(lambda p: p.status, plan, status)

        self._first, self._tick, self._running = jax.jit(first), jax.jit(tick), jax.jit(running)
        self._most = 0
        self._warm: set[tuple] = set()
        self.dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))

    def first(self, part: Part, motion: Motion) -> Memory:
        """Before any tick; ``motion`` is of all nodes."""
        position, velocity = motion
        inputs = position[part.who], velocity[part.who], part.nodes, part.cost
        return self._first(self._weights, *inputs, part.who.astype(np.int32))

    def __call__(
        self,
        part: Part,
        memory: Memory,
        motion: Motion,
        contact: np.ndarray,
        applied: np.ndarray,
    ) -> Memory:
        """See `Controller.tick`; ``motion`` is of all nodes, ``contact`` [e] of those in play."""
        position, velocity = motion
        inputs = position[part.who], velocity[part.who], contact, applied
        return self._tick(self._weights, part.nodes, part.cost, memory, *inputs)

    def running(self, memory: Memory, status: PlanStatus) -> Plan:
        """The last plan from the present on, under this status."""
        return self._running(self._weights, memory, np.asarray(status, np.int32))

    def make_room(self, count: int) -> None:
        """Says so in the log where the coming tick compiles for more nodes in play than before."""
        if self._most and count > self._most:
            _log.warning(
                "compiling a tick for up to %d nodes in play; so far there was room for %d",
                count,
                self._most,
            )
        self._most = max(self._most, count)

    def warm_up(self, part: Part, motion: Motion, contact: np.ndarray, applied: np.ndarray) -> None:
        """Compile for parts like this one, where that has not been done."""
        leaves = jax.tree.leaves((part.nodes, part.cost))
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if shapes in self._warm:
            return
        self._warm.add(shapes)
        self.make_room(len(part.who))
        memory = self(part, self.first(part, motion), motion, contact, applied)
        jax.block_until_ready(memory)
        if self._falls_back:
            self.running(memory, PlanStatus.DEADLINE_MISSED)

    def strongly_typed(self, values: _Tree) -> _Tree:
        """Every float of one type and none of them weak: else the second tick would compile
        again."""

        def typed(value: Any) -> np.ndarray:
            array = np.asarray(value)
            return array.astype(self.dtype) if np.issubdtype(array.dtype, np.floating) else array

        # Made by NumPy and moved: each `jax.numpy` call would compile a little program.
        return jax.device_put(jax.tree.map(typed, values))
