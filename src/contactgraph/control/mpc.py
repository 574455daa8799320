"""Model predictive control through contact: one compiled call a tick."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.lqr import LQRPolicy
from contactgraph.control.measurement import MeasurementReader, Observation
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.tick import Controller, MPCState, Seen
from contactgraph.data import InvalidInputError
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    MotionNoise,
    Nodes,
    StepModel,
    judging_motion,
)

_EXACT = ContactSensor()


class MPC:
    """Plans anew at every tick, from what was observed and which contacts were measured.

    ```python
    mpc = MPC(model, ILQR(horizon=20, limits=limits))
    state = mpc.reset(observation, nodes, cost)
    while True:
        plan, state = mpc.step(observation, contacts, state)
        apply(plan.controls[0])
    ```

    A tick corrects the belief about the step just made by the contacts measured now (the paper's
    posterior), plans from there with the last plan as the guess, and carries the belief that the
    model predicts for the step it is about to make. With a ``motion_noise`` the motion observed
    corrects the belief too, so that a contact is found without a sensor: see `judge_motion`.

    Goals, weights, poses, contacts and the number of nodes within the capacity are arguments of
    the compiled tick and do not recompile it; the horizon, the capacity and the number of nodes
    with a cost do. `reset` compiles, so that no tick has to.

    **A bad tick is data.** A non-finite observation, or a prediction that is not finite, gives
    the running plan moved on by one step, under its `PlanStatus`; a non-finite contact counts as
    not measured. Controls are finite and within limits whatever comes in.

    **Deadline.** A Python thread cannot interrupt a compiled call. What bounds a tick is
    ``ilqr.iterations``. With a deadline the time of each tick is measured, and one that took
    longer answers with the plan that was running before, marked LATE: it was made for this
    moment, as predicted. The plan that came too late is complete and is the next tick's guess.
    """

    def __init__(
        self,
        model: StepModel,
        ilqr: ILQR,
        sensor: ContactSensor = _EXACT,
        replan_every: int = 1,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        motion_noise: MotionNoise | None = None,
    ) -> None:
        """``deadline`` in seconds, from the call of `step` to the plan; ``clock`` measures it.

        ``motion_noise`` None: beliefs are corrected by measured contacts alone.
        Raises `InvalidInputError` for a ``replan_every`` outside ``1 … horizon``, a deadline that
        is not positive, or a ``motion_noise`` with a model that cannot judge motion.
        """
        if not 1 <= replan_every <= ilqr.horizon:
            raise InvalidInputError(
                f"replan_every must be 1 to the horizon ({ilqr.horizon}), found {replan_every}"
            )
        if deadline is not None and not deadline > 0:
            raise InvalidInputError(f"deadline must be positive seconds, found {deadline}")
        if motion_noise is not None:
            judging_motion(model)
        self._deadline = deadline
        self._clock = clock
        self._controller = Controller(model, ilqr, sensor, motion_noise, replan_every)
        # A flat tuple of arrays is dispatched faster than the tree they came from, and weights
        # that are arguments, not constants, are neither folded nor compiled in.
        dynamic, static = eqx.partition(self._controller, eqx.is_array)
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
        self._dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))
        self._readers: dict[tuple[int, int], MeasurementReader] = {}

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """Begin a run: the model's first belief and a first plan. Compiles where need be.

        Raises `InvalidInputError` where the observation is not finite or shapes do not fit.
        """
        capacity = nodes.mask.shape[0]
        quadratic = cost.quadratic(capacity)
        size = quadratic.goal.shape[-1]
        if size % (2 * capacity):
            raise InvalidInputError(
                f"cost.goal must have 2ND entries for the capacity N = {capacity}, found {size}"
            )
        reader = self._reader(capacity, size)
        position, velocity = reader.motion(observation)
        mask = np.asarray(nodes.mask)
        for name, value in (("position", position), ("velocity", velocity)):
            if not np.all(np.isfinite(value[mask])):
                raise InvalidInputError(f"observation's {name} must be finite to begin with")
        hidden = ~mask[:, None]
        position, velocity = np.where(hidden, 0, position), np.where(hidden, 0, velocity)
        belief = self._first_belief(self._weights, position, velocity, nodes)
        nothing = jnp.full(position.shape, jnp.nan)
        state = _strongly_typed(
            MPCState(
                nodes=nodes,
                cost=quadratic,
                belief=belief,
                plan=self._no_plan(size, quadratic, belief),
                unplanned=jnp.asarray(self._controller.replan_every, jnp.int32),
                seen=Seen(
                    position=nothing,
                    velocity=nothing,
                    belief=belief,
                    told=jnp.zeros(nodes.candidate.shape),
                    control=jnp.zeros(quadratic.control_size),
                ),
                fresh=jnp.ones((), bool),
            ),
            self._dtype,
        )
        unknown = self._applied(None, quadratic.control_size)
        inputs = position, velocity, reader.contact(None), unknown
        plan, _ = self._tick(self._weights, state, *inputs)
        state = eqx.tree_at(lambda s: s.plan, state, plan)
        jax.block_until_ready(self._running(self._weights, state))
        return state

    def step(
        self,
        observation: Observation,
        contacts: np.ndarray | None,
        state: MPCState,
        applied: np.ndarray | None = None,
    ) -> tuple[Plan, MPCState]:
        """One tick: the plan whose ``controls[0]`` [N] to apply now, and the state to pass on.

        ``contacts``: [n, n], symmetric, 1 touching, 0 not, NaN not measured; None: nothing is.
        ``applied``: [U] N, what was applied, on its mean, since the last tick, where feedback or a
        robot's limits made it another control than the last plan's first; None: that one.
        Raises `InvalidInputError` where shapes do not fit, and never for a value.
        """
        begin = self._clock()
        reader = self._reader(state.nodes.mask.shape[0], state.plan.states.shape[-1])
        position, velocity = reader.motion(observation)
        contact = reader.contact(contacts)
        told = self._applied(applied, state.plan.controls.shape[-1])
        plan, after = self._tick(self._weights, state, position, velocity, contact, told)
        if self._deadline is not None:
            jax.block_until_ready(plan.controls)
            if self._clock() - begin > self._deadline:
                plan = self._running(self._weights, state).with_status(PlanStatus.LATE)
                after = eqx.tree_at(lambda s: s.seen.control, after, plan.controls[0])
        return plan, after

    def control(self, plan: Plan, observation: Observation) -> np.ndarray:
        """[U] N: the plan's first control with its feedback on a later observation.

        For a loop that is faster than the planner. Falls back on ``plan.controls[0]`` where the
        observation is not finite.
        """
        size, dimension = plan.states.shape[-1], np.shape(observation["position"])[-1]
        position, velocity = self._reader(size // (2 * dimension), size).motion(observation)
        x = np.stack([position, velocity], axis=1).reshape(-1)
        K, k = np.asarray(plan.policy.K[0]), np.asarray(plan.policy.k[0])
        used = np.any(K != 0, axis=0)
        u = K[:, used] @ x[used] + k
        u = u if np.all(np.isfinite(u)) else np.asarray(plan.controls[0])
        limits = self._controller.ilqr.limits
        return u if limits is None else np.clip(u, limits.lower, limits.upper)

    def _applied(self, applied: np.ndarray | None, control_size: int) -> np.ndarray:
        """[U]; NaN where nobody said."""
        if applied is None:
            return np.full(control_size, np.nan, self._dtype)
        told = np.asarray(applied, self._dtype)
        if told.shape != (control_size,):
            raise InvalidInputError(
                f"applied must have shape ({control_size},), the control's, found {told.shape}"
            )
        return told

    def _reader(self, capacity: int, size: int) -> MeasurementReader:
        """For ``N`` nodes with ``size = 2ND``."""
        key = (capacity, size)
        if key not in self._readers:
            self._readers[key] = MeasurementReader(capacity, size // (2 * capacity), self._dtype)
        return self._readers[key]

    def _no_plan(self, size: int, cost: QuadraticCost, belief: ContactBelief) -> Plan:
        horizon, U = self._controller.ilqr.horizon, cost.control_size
        return Plan(
            states=jnp.zeros((horizon + 1, size)),
            controls=jnp.zeros((horizon, U)),
            policy=LQRPolicy(jnp.zeros((horizon, U, size)), jnp.zeros((horizon, U))),
            beliefs=jax.tree.map(lambda v: jnp.broadcast_to(v, (horizon, *v.shape)), belief),
            cost=jnp.zeros(()),
            status=jnp.asarray(PlanStatus.NOT_FINITE, jnp.int32),
            iterations=jnp.zeros((), jnp.int32),
        )


def _strongly_typed(state: MPCState, dtype: np.dtype) -> MPCState:
    """Every float of one type and none of them weak: else the second tick would compile again."""

    def typed(value: Any) -> jax.Array:
        array = jnp.asarray(value)
        kind = dtype if jnp.issubdtype(array.dtype, jnp.floating) else array.dtype
        return jnp.asarray(np.asarray(array), kind)

    return jax.tree.map(typed, state)
