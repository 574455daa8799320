"""The tick, compiled: once for each room that nodes in play are given."""

import logging
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control.cost import QuadraticCost
from contactgraph.control.lqr import LQRPolicy
from contactgraph.control.measurement import Motion
from contactgraph.control.mpc_state import MPCState, Seen
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.swept import Swept
from contactgraph.control.tick import Controller
from contactgraph.model import ContactBelief, Nodes

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

        self._tick = jax.jit(tick)
        self._running = jax.jit(lambda weights, state: rebuilt(weights).running_plan(state))
        self._first_belief = jax.jit(
            lambda weights, *inputs: rebuilt(weights).model.initial_belief(*inputs)
        )
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
        last_seen: Motion | None = None,
    ) -> tuple[Plan, MPCState]:
        """See `Controller.tick`; ``position``, … are of the nodes in play.

        ``last_seen``: of all nodes, to be remembered where only a part of them is in play.
        """
        plan, after = self._tick(self._weights, _in_play(state), position, velocity, contact, applied)
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
        return self._running(self._weights, _in_play(state)).with_status(status)

    def first_belief(
        self, position: np.ndarray, velocity: np.ndarray, nodes: Nodes
    ) -> ContactBelief:
        """See `StepModel.initial_belief`."""
        return self._first_belief(self._weights, position, velocity, nodes)

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
        jax.block_until_ready(self._running(self._weights, _in_play(state)))

    def first_state(
        self, position: np.ndarray, velocity: np.ndarray, nodes: Nodes, cost: QuadraticCost
    ) -> MPCState:
        """Before any tick, without a plan, all of these nodes in play."""
        belief = self.first_belief(position, velocity, nodes)
        horizon, control_size = self.controller.ilqr.horizon, cost.control_size
        count, size = len(position), cost.goal.shape[-1]
        nothing = jnp.full(position.shape, jnp.nan)
        plan = Plan(
            states=jnp.zeros((horizon + 1, size)),
            controls=jnp.zeros((horizon, control_size)),
            policy=LQRPolicy(
                jnp.zeros((horizon, control_size, size)), jnp.zeros((horizon, control_size))
            ),
            beliefs=jax.tree.map(lambda v: jnp.broadcast_to(v, (horizon, *v.shape)), belief),
            cost=jnp.zeros(()),
            status=jnp.asarray(PlanStatus.NOT_FINITE, jnp.int32),
            iterations=jnp.zeros((), jnp.int32),
            who=jnp.arange(count, dtype=jnp.int32),
        )
        swept = None
        if self.controller.locality is not None:
            swept = Swept.nowhere(horizon, jnp.asarray(position))
        state = MPCState(
            nodes=nodes,
            cost=cost,
            belief=belief,
            plan=plan,
            unplanned=jnp.asarray(self.controller.replan_every, jnp.int32),
            seen=Seen(
                position=nothing,
                velocity=nothing,
                belief=belief,
                told=jnp.zeros(nodes.candidate.shape),
                control=jnp.zeros(control_size),
            ),
            fresh=jnp.ones((), bool),
            swept=swept,
        )
        return self.strongly_typed(state)

    def strongly_typed(self, values: _Tree) -> _Tree:
        """Every float of one type and none of them weak: else the second tick would compile
        again."""

        def typed(value: Any) -> jax.Array:
            array = jnp.asarray(value)
            kind = self.dtype if jnp.issubdtype(array.dtype, jnp.floating) else array.dtype
            return jnp.asarray(np.asarray(array), kind)

        return jax.tree.map(typed, values)


def _in_play(state: MPCState) -> MPCState:
    """The state as the compiled functions take it, in which those in play are all there are."""
    part = state.part
    if part is None:
        return state
    return replace(state, nodes=part.nodes, cost=part.cost, part=None, last_seen=None)
