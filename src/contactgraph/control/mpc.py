"""Model predictive control through contact: one compiled call a tick."""

import time
from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np

from contactgraph.control.compiled_tick import CompiledTick
from contactgraph.control.cost import Cost
from contactgraph.control.host import MeasurementReader, Motion, Observation
from contactgraph.control.ilqr import ILQR
from contactgraph.control.local_tick import LocalTick
from contactgraph.control.mpc_state import MPCState
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.tick import Controller
from contactgraph.data import InvalidInputError
from contactgraph.model import (
    ContactSensor,
    MotionNoise,
    Nodes,
    StepModel,
    check_motion_model,
    interaction_cutoff,
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
    corrects the belief too, so that a contact is found without a sensor: see
    `contact_log_likelihood_ratio`.

    **Who matters.** With a model whose edges have an end (`interaction_cutoff`), a tick is about
    the nodes in play alone, and takes next to no longer for all the bystanders that a scene may
    hold; the answer is that of a tick about all. See `contactgraph.control.in_play`, and
    `Plan.who`.

    Goals, weights, poses, contacts and the number of nodes within the capacity are arguments of
    the compiled tick and do not recompile it; the horizon, the capacity (where all are in play)
    and the number of nodes with a cost do. `reset` compiles, so that no tick has to, but where
    more nodes come into play than ever: that is logged, and happens once for up to 54, 162, …
    nodes. With ``max_active_nodes`` it never happens; a tick that would need more
    is CAPACITY_EXCEEDED.

    **A bad tick is data.** A non-finite observation, or a prediction that is not finite, gives
    the running plan moved on by one step, under its `PlanStatus`; a non-finite contact counts as
    not measured. Controls are finite and within limits whatever comes in.

    **Deadline.** A Python thread cannot interrupt a compiled call. What bounds a tick is
    ``ilqr.iterations``. With a deadline the time of each tick is measured, and one that took
    longer answers with the plan that was running before, marked DEADLINE_MISSED: it was made
    for this moment, as predicted. The plan that came too late is complete and is the next tick's
    guess.
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
        max_active_nodes: int | None = None,
    ) -> None:
        """``deadline`` in seconds, from the call of `step` to the plan; ``clock`` measures it.

        ``motion_noise`` None: beliefs are corrected by measured contacts alone.
        ``max_active_nodes`` nodes may matter to a plan; None: however many do.
        Raises `InvalidInputError` for a ``replan_every`` outside ``1 … horizon``, a deadline or a
        limit that is not positive, or a ``motion_noise`` with a model that cannot judge motion.
        """
        if not 1 <= replan_every <= ilqr.horizon:
            raise InvalidInputError(
                f"replan_every must be 1 to the horizon ({ilqr.horizon}), found {replan_every}"
            )
        if deadline is not None and not deadline > 0:
            raise InvalidInputError(f"deadline must be positive seconds, found {deadline}")
        if motion_noise is not None:
            check_motion_model(model)
        if max_active_nodes is not None and max_active_nodes < 1:
            raise InvalidInputError(
                f"max_active_nodes must be at least 1, found {max_active_nodes}"
            )
        self._deadline = deadline
        self._clock = clock
        # Rates by edge are about the scene as a whole.
        near = (
            interaction_cutoff(model)
            if np.ndim(sensor.false_alarm) + np.ndim(sensor.miss) == 0
            else None
        )
        self._compiled = CompiledTick(
            Controller(model, ilqr, sensor, motion_noise, replan_every, near),
            falls_back=deadline is not None or max_active_nodes is not None,
        )
        self._local = LocalTick(self._compiled, near, max_active_nodes)
        self._readers: dict[tuple[int, int], MeasurementReader] = {}

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """Begin a run: the model's first belief and a first plan. Compiles where need be.

        Raises `InvalidInputError` where the observation is not finite, shapes do not fit, or more
        nodes are in play than may be.
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
        return self._local.begin(reader, _shown(mask, position, velocity), nodes, quadratic)

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
        Raises `InvalidInputError` where shapes do not fit, or a cost that was replaced is about
        more nodes than may be in play; and never for a value.
        """
        begin = self._clock()
        mask = np.asarray(state.nodes.mask)
        reader = self._reader(len(mask), state.cost.goal.shape[-1])
        motion = _shown(mask, *reader.motion(observation))
        told = reader.applied(applied, state.plan.controls.shape[-1])
        plan, after, crowded = self._local(state, reader, motion, contacts, told)
        status = PlanStatus.CAPACITY_EXCEEDED if crowded else None
        if self._deadline is not None:
            jax.block_until_ready(plan.controls)
            status = (
                PlanStatus.DEADLINE_MISSED if self._clock() - begin > self._deadline else status
            )
        if status is None:
            return plan, after
        plan = self._compiled.running(state.memory, status)
        control = jax.device_put(np.asarray(plan.controls)[0])
        seen = replace(after.seen, control=control)
        return plan, replace(after, memory=replace(after.memory, seen=seen))

    def control(self, plan: Plan, observation: Observation) -> np.ndarray:
        """[U] N: the plan's first control with its feedback on a later observation.

        For a loop that is faster than the planner. Falls back on ``plan.controls[0]`` where the
        observation is not finite.
        """
        who = np.asarray(plan.who)
        count, dimension = np.shape(observation["position"])
        capacity = max(count, int(who.max()) + 1)
        position, velocity = self._reader(capacity, 2 * capacity * dimension).motion(observation)
        x = np.stack([position[who], velocity[who]], axis=1).reshape(-1)
        K, k = np.asarray(plan.policy.K[0]), np.asarray(plan.policy.k[0])
        used = np.any(K != 0, axis=0)
        u = K[:, used] @ x[used] + k
        u = u if np.all(np.isfinite(u)) else np.asarray(plan.controls[0])
        limits = self._compiled.controller.ilqr.limits
        return u if limits is None else np.clip(u, limits.lower, limits.upper)

    def _reader(self, capacity: int, size: int) -> MeasurementReader:
        """For ``N`` nodes with ``size = 2ND``."""
        key = (capacity, size)
        if key not in self._readers:
            dimension = size // (2 * capacity)
            self._readers[key] = MeasurementReader(capacity, dimension, self._compiled.dtype)
        return self._readers[key]


def _shown(mask: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> Motion:
    """Whatever padding holds, it is zero."""
    hidden = ~mask[:, None]
    return np.where(hidden, 0, position), np.where(hidden, 0, velocity)
