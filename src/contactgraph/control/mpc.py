"""Model predictive control through contact: one compiled call a control step."""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import jax
import numpy as np

from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.host import (
    Motion,
    Observation,
    applied_control,
    edge_contacts,
    padded_motion,
    placed,
)
from contactgraph.control.mpc_step import MPCCarry, MPCConfig, jit_step
from contactgraph.control.plan import Plan, Planner, PlanStatus
from contactgraph.data import InvalidInputError
from contactgraph.data.turns import near_turn
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    ModelState,
    MotionNoise,
    Nodes,
    StepModel,
    check_motion_model,
    default_sensor,
    turn_length_of,
)

_State = TypeVar("_State", bound="MPCState")


@dataclass(frozen=True, eq=False)
class MPCState:
    """State between two control steps."""

    nodes: Nodes
    cost: QuadraticCost
    node_ids: np.ndarray
    """[N] The scene's nodes that all of this is about, in their order; -1 for padding."""
    carry: MPCCarry

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


class MPC:
    """Plans at every control step, from an observation and the contacts measured with it.

    >>> import contactgraph
    >>> from contactgraph.control import ILQR, chain_cost
    >>> from contactgraph.model import scene_nodes
    >>> model, task = contactgraph.load("pickup"), contactgraph.make("pickup")
    >>> observation, _ = task.reset(seed=0)
    >>> pick, goal = [3, 3, 0.2, 0.2], [50, 50, 1, 1]
    >>> cost = chain_cost([0, 1], pick, goal, 0.01, task.scene.goal, node_count=2)
    >>> mpc = MPC(model, ILQR(horizon=5))
    >>> state = mpc.reset(observation, scene_nodes(task.scene), cost)
    >>> plan, state = mpc.step(observation, observation["contact"], state)
    >>> observation, *_ = task.step(plan.controls[0])
    >>> plan.outcome.message
    'Converged: no further decrease of the cost is expected.'

    A control step corrects the belief about the step just made by the contacts measured now (the
    paper's posterior), plans from there with the previous plan as the guess, and carries the belief
    that the model predicts for the coming step. With a ``motion_noise`` the observed motion
    corrects the belief too: see `correct_by_motion`.

    The plan is about all nodes: `ActiveSetMPC` gives the same plans in scenes of many nodes in less
    time. Goals, weights, poses, contacts and the number of nodes within the capacity are arguments
    of the compiled step and do not recompile it; the horizon, the capacity and the number of nodes
    with a cost do. `reset` compiles, so that no step has to.

    **A bad step is data.** A non-finite observation, or a prediction that is not finite, gives the
    previous plan shifted by one step, under its `PlanStatus`; a non-finite contact counts as not
    measured. Controls are finite and within limits whatever comes in.

    **Deadline.** A Python thread cannot interrupt a compiled call: the planner's ``iterations``
    bound a step's time. With a deadline each step's time is measured. A step that took longer
    answers with the previous plan, shifted, as DEADLINE_MISSED; the plan that came too late is
    complete and is the next step's guess.
    """

    def __init__(
        self,
        model: StepModel,
        planner: Planner,
        sensor: ContactSensor | None = None,
        replan_every: int = 1,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        motion_noise: MotionNoise | None = None,
    ) -> None:
        """``sensor`` None: the model's `default_sensor`; late reports count as current ones.

        ``deadline`` in seconds, from the call of `step` to the plan; ``clock`` measures it.

        ``motion_noise`` None: beliefs are corrected by measured contacts alone. Raises
        `InvalidInputError` for a ``replan_every`` outside ``1 … horizon``, a deadline that is not
        positive, or a ``motion_noise`` with a model that cannot judge motion.
        """
        if not 1 <= replan_every <= planner.horizon:
            raise InvalidInputError(
                f"replan_every must be 1 to the horizon ({planner.horizon}), found {replan_every}"
            )
        if deadline is not None and not deadline > 0:
            raise InvalidInputError(f"deadline must be positive seconds, found {deadline}")
        if motion_noise is not None:
            check_motion_model(model)
        sensor = (default_sensor(model) if sensor is None else sensor).as_current
        self.config = MPCConfig(model, planner, sensor, motion_noise, replan_every)
        self.dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))
        self.deadline, self.clock = deadline, clock
        self._compile()

    def with_swept_bounds(self, dt: float) -> "MPC":
        """The same, whose states hold the bounds of their plans; ``dt`` [s] is the model's step."""
        same = copy.copy(self)
        same.config = replace(self.config, swept_dt=dt)
        same._compile()
        return same

    def _compile(self) -> None:
        self._first = jit_step(MPCConfig.first_carry, self.config)
        self._step = jit_step(MPCConfig.step, self.config, like=2)
        self._previous = jit_step(MPCConfig.previous_plan, self.config)

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """Begin an episode: the model's first belief and a first plan. Compiles where need be.

        Raises `InvalidInputError` where the observation is not finite or shapes do not fit.
        """
        nodes, quadratic = self.checked(nodes, cost)
        motion = self.first_motion(observation, nodes, quadratic)
        state = self.first(nodes, quadratic, np.arange(len(nodes.mask)), motion)
        after = self.advance(state, motion)
        if self.deadline is not None:
            self.answer(0.0, state, after, PlanStatus.DEADLINE_MISSED)
        return replace(state, carry=replace(state.carry, plan=after.plan))

    def step(
        self,
        observation: Observation,
        contacts: np.ndarray | None,
        state: MPCState,
        applied: np.ndarray | None = None,
        *,
        nodes: Nodes | None = None,
        cost: Cost | None = None,
        replan: bool | None = None,
    ) -> tuple[Plan, MPCState]:
        """One control step: the plan whose ``controls[0]`` [N] to apply now, and the next state.

        ``contacts``: [n, n], symmetric, 1 touching, 0 not, NaN not measured; None: nothing is.
        ``applied``: [U] N, mean control applied since the last step; None: the last plan's first.
        ``nodes``, ``cost``: replace the state's from now on. ``replan``: True makes a plan now,
        False reuses the previous one; None: every ``replan_every`` steps.
        Raises `InvalidInputError` where shapes do not fit, never for a value.
        """
        begin = self.clock()
        if nodes is not None or cost is not None:
            about = state.nodes if nodes is None else nodes, state.cost if cost is None else cost
            checked = self.checked(*about)
            state = replace(state, nodes=checked[0], cost=checked[1])
        motion = self.motion(observation, state.nodes, state.cost)
        return self.answer(begin, state, self.advance(state, motion, contacts, applied, replan))

    def control(self, plan: Plan, observation: Observation) -> np.ndarray:
        """[U] N: the plan's first control with its feedback on a later observation.

        For a loop that is faster than the planner. Falls back on ``plan.controls[0]`` where the
        observation is not finite.
        """
        ids = np.asarray(plan.node_ids)
        count, dimension = np.shape(observation["position"])
        capacity = max(count, int(ids.max()) + 1)
        turn_length = turn_length_of(self.config.model)
        position, velocity = padded_motion(
            observation, capacity, dimension, self.dtype, turn_length
        )
        first: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[0], plan.policy)
        x = np.stack([position[ids], velocity[ids]], axis=1)
        # A node without a gain may be anywhere, or not observed.
        control = np.asarray(first(np.where(np.any(first.K != 0, axis=0), x, 0.0)))
        control = control if np.all(np.isfinite(control)) else np.asarray(plan.controls)[0]
        limits = self.config.planner.limits
        return control if limits is None else np.clip(control, limits.lower, limits.upper)

    def checked(self, nodes: Nodes, cost: Cost) -> tuple[Nodes, QuadraticCost]:
        """In shapes that fit, on the device, without weak types: these would compile again."""
        capacity = len(nodes.mask)

        def typed(value: Any) -> np.ndarray:
            array = np.asarray(value)
            return array.astype(self.dtype) if np.issubdtype(array.dtype, np.floating) else array

        # Made by NumPy and moved: each `jax.numpy` call would compile a program of its own.
        nodes, quadratic = jax.tree.map(typed, (nodes, cost.quadratic(capacity)))
        fitted = quadratic.fitted(self.config.model, capacity, np)
        return placed((nodes, fitted))

    def motion(self, observation: Observation, nodes: Nodes, cost: QuadraticCost) -> Motion:
        """Of all nodes [N, G]; zero for padding, whatever was observed there."""
        mask = np.asarray(nodes.mask)[:, None]
        coordinates = cost.goal.shape[-1] // (2 * len(mask))
        model = self.config.model
        dimension = getattr(model, "dimension", coordinates)
        position, velocity = padded_motion(
            observation, len(mask), dimension, self.dtype, turn_length_of(model)
        )
        matters = np.repeat(mask, coordinates, axis=1)
        if coordinates > dimension and nodes.outlines is not None:
            outlines = np.asarray(nodes.outlines).reshape(len(mask), -1)
            matters[:, dimension:] &= np.any(outlines, axis=1)[:, None]
        return np.where(matters, position, 0), np.where(matters, velocity, 0)

    def first_motion(self, observation: Observation, nodes: Nodes, cost: QuadraticCost) -> Motion:
        """As `motion`; raises `InvalidInputError` where it is not finite."""
        motion = self.motion(observation, nodes, cost)
        for name, value in zip(("position", "velocity"), motion, strict=True):
            if not np.all(np.isfinite(value)):
                raise InvalidInputError(f"observation's {name} must be finite to begin with")
        return motion

    def first(
        self, nodes: Nodes, cost: QuadraticCost, node_ids: np.ndarray, motion: Motion
    ) -> MPCState:
        """The state before any control step; ``motion`` is of all nodes of the scene."""
        moved = motion[0][node_ids], motion[1][node_ids]
        carry = self._first(nodes, cost, *moved, node_ids.astype(np.int32))
        return MPCState(nodes, cost, node_ids, carry)

    def advance(
        self,
        state: _State,
        motion: Motion,
        contacts: np.ndarray | None = None,
        applied: np.ndarray | None = None,
        replan: bool | None = None,
    ) -> _State:
        """The state after a control step; ``motion`` and ``contacts`` are of the whole scene."""
        if replan is False and self.config.replan_every == 1:
            raise InvalidInputError("replan=False needs a replan_every above 1")
        position, velocity = (each[state.node_ids] for each in motion)
        if position.shape[1] == 6:  # a turn in space is observed up to whole turns
            unit, last = turn_length_of(self.config.model), np.asarray(state.last.position)
            position[:, 3:] = unit * near_turn(position[:, 3:] / unit, last[:, 3:] / unit)
        carry = self._step(
            state.nodes,
            state.cost,
            state.carry,
            position,
            velocity,
            edge_contacts(contacts, state.node_ids, len(motion[0]), self.dtype),
            applied_control(applied, state.cost.control_size, self.dtype),
            np.asarray(-1 if replan is None else replan, np.int32),
        )
        return replace(state, carry=carry)

    def answer(
        self, begin: float, state: MPCState, after: _State, status: PlanStatus | None = None
    ) -> tuple[Plan, _State]:
        """The new plan; or ``state``'s, shifted, where that one is late or there is a status."""
        if self.deadline is not None:
            jax.block_until_ready(after.plan.controls)
            late = self.clock() - begin > self.deadline
            status = PlanStatus.DEADLINE_MISSED if late else status
        if status is None:
            return after.plan, after
        plan = self._previous(state.carry, np.asarray(status, np.int32))
        known = replace(after.carry.filter, control=placed(np.asarray(plan.controls)[0]))
        return plan, replace(after, carry=replace(after.carry, filter=known))
