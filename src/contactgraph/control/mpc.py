"""Model predictive control through contact: one compiled call a control step."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.host import (
    Measured,
    Observation,
    applied_control,
    padded_contacts,
    padded_motion,
    placed,
)
from contactgraph.control.mpc_step import MPCConfig, jit_step
from contactgraph.control.plan import Plan, Planner, PlanStatus
from contactgraph.control.subproblem import MPCState, active_part
from contactgraph.data import InvalidInputError
from contactgraph.data.turns import near_turn
from contactgraph.model import (
    ContactSensor,
    MotionNoise,
    Nodes,
    StepModel,
    check_motion_model,
    default_sensor,
    turn_length_of,
)


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

    def _compile(self) -> None:
        self._first = jit_step(MPCConfig.first_carry, self.config)
        self._step = jit_step(MPCConfig.step, self.config, like=2)
        self._previous = jit_step(MPCConfig.previous_plan, self.config)

    def reset(self, observation: Observation, nodes: Nodes, cost: Cost) -> MPCState:
        """Begin an episode: the model's first belief and a first plan. Compiles where need be.

        Raises `InvalidInputError` where the observation is not finite or shapes do not fit.
        """
        scene = self.checked(nodes, cost)
        seen, every = self.measured(observation, scene), np.arange(len(scene[0].mask))
        state = self.first(active_part(scene, every, every, seen[:2]))
        after = self.advance(state, seen)
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
        begin, current = self.clock(), state
        if nodes is not None or cost is not None:
            known = state.scene
            nodes, cost = known[0] if nodes is None else nodes, known[1] if cost is None else cost
            current = self.in_scene(state, self.checked(nodes, cost))
        seen = self.measured(observation, current.scene, contacts, applied, replan)
        return self.answer(begin, state, self.planned(current, seen))

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

    def measured(
        self,
        observation: Observation,
        scene: tuple[Nodes, QuadraticCost],
        contacts: np.ndarray | None = None,
        applied: np.ndarray | None = None,
        replan: bool | None = None,
    ) -> Measured:
        """What `step` was given, about all nodes; zero for padding, whatever was observed there."""
        model, mask = self.config.model, np.asarray(scene[0].mask)[:, None]
        coordinates = scene[1].goal.shape[-1] // (2 * len(mask))
        dimension = getattr(model, "dimension", coordinates)
        position, velocity = padded_motion(
            observation, len(mask), dimension, self.dtype, turn_length_of(model)
        )
        matters = np.repeat(mask, coordinates, axis=1)
        if coordinates > dimension and scene[0].outlines is not None:
            outlines = np.asarray(scene[0].outlines).reshape(len(mask), -1)
            matters[:, dimension:] &= np.any(outlines, axis=1)[:, None]
        if replan is False and self.config.replan_every == 1:
            raise InvalidInputError("replan=False needs a replan_every above 1")
        return Measured(
            np.where(matters, position, 0),
            np.where(matters, velocity, 0),
            padded_contacts(contacts, len(mask), self.dtype),
            applied_control(applied, scene[1].control_size, self.dtype),
            np.asarray(-1 if replan is None else replan, np.int32),
        )

    def in_scene(self, state: MPCState, scene: tuple[Nodes, QuadraticCost]) -> MPCState:
        """The state in a scene of other nodes, or with another cost."""
        return replace(state, nodes=scene[0], cost=scene[1], scene=scene)

    def first(self, part: MPCState) -> MPCState:
        """The part of a scene before any control step; its motion must be finite."""
        for name, values in zip(("position", "velocity"), part.last_motion, strict=True):
            if not np.all(np.isfinite(values)):
                raise InvalidInputError(f"observation's {name} must be finite to begin with")
        position, velocity = (each[part.node_ids] for each in part.last_motion)
        ids = part.node_ids.astype(np.int32)
        return replace(part, carry=self._first(part.nodes, part.cost, position, velocity, ids))

    def planned(self, state: MPCState, seen: Measured) -> MPCState:
        """The state after a control step."""
        return self.advance(state, seen)

    def advance(self, state: MPCState, seen: Measured) -> MPCState:
        """The state after one call of the compiled step about the active nodes."""
        part = seen.among(state.node_ids)
        if part.position.shape[1] == 6:  # a turn in space is observed up to whole turns
            unit, last = turn_length_of(self.config.model), np.asarray(state.last.position)
            turns = part.position[:, 3:]
            turns[:] = unit * near_turn(turns / unit, last[:, 3:] / unit)
        return replace(state, carry=self._step(state.nodes, state.cost, state.carry, part))

    def answer(
        self, begin: float, state: MPCState, after: MPCState, status: PlanStatus | None = None
    ) -> tuple[Plan, MPCState]:
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
