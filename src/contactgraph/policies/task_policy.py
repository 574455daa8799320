"""MPC as the policy of a task: its planner, cost, sensor and limits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from contactgraph.control import (
    ILQR,
    MPC,
    ActiveSetMPC,
    Approaches,
    ChangingSchedules,
    ConstantSchedule,
    ControlLimits,
    Leap,
    MultiStartILQR,
    Planner,
    Proposal,
    Routes,
    ShortPlans,
    searches,
)
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Task
from contactgraph.model import MotionNoise, StepModel, default_sensor, turn_length_of
from contactgraph.model.scene import check_fit
from contactgraph.policies.mpc_policy import EXACT, NOISELESS, MPCPolicy
from contactgraph.policies.sensor_faults import ObservationNoise, SensorFault
from contactgraph.policies.task_cost import SceneCost, TaskCost

PlannerFactory = Callable[..., Planner]
"""Called with the keywords ``horizon`` [steps] and ``limits``, a `ControlLimits`."""

_SERVOS = {"position", "displacement", "velocity"}
_SEVERAL = 4
"""Bodies in a row from which on the horizon is longer, and plans leap."""
_HORIZON_WITHOUT_CONTACTS = 2
"""Factor of the default horizon with a learned cost that does not demand the contacts that its
demonstrations made: a plan that ends before their benefit would hover before the object."""
_ROUTES = 7
"""With a clearance: with the running plan they fill a vector of eight."""
_LEAP_ROLLOUTS = 3
"""More rollouts for a plan with switches: a schedule that leaps pays after seven or eight only."""


def switches_of(scene: Scene) -> tuple[int, ...]:
    """The components of the control that are switches."""
    return tuple(each for each, kind in enumerate(scene.control_kind or ()) if kind == "switch")


@dataclass(frozen=True)
class Planning:
    """How a task's plans are made. What is None is `chosen`."""

    horizon: int | None = None
    """Steps."""
    iterations: int = 5
    """Rollouts of iLQR, at most."""
    starts: int | None = None
    """Of `Approaches`; 0: none."""
    routes: int | None = None
    """Of `Routes`; 0: none."""
    segment: int = 0
    """Of `ShortPlans`; 0: none."""
    clearance: float | None = None
    """Gap to be kept from bodies that the task does not name, m; 0 forbids touches alone."""
    leap: bool | None = None
    """Whether one start is a `Leap`."""
    planner: PlannerFactory | None = None
    """Makes another planner in the place of iLQR and its starts."""
    reason: str = "as asked for"
    """Why the horizon is what it is."""

    def chosen(self, task: Task, model: StepModel, cost: SceneCost | None = None) -> "Planning":
        """What is missing, for a task that has begun an episode; ``cost`` None is the task's own.

        What the task's attributes ``horizon``, ``starts`` and ``clearance`` do not give follows
        from what is controlled: a servo, or a displacement, pushes and cannot pull, so a plan is
        long and begins with a search for the side to push from. Forces act on what is touched and
        held, where iLQR needs neither; but the time that a force takes over a distance grows with
        the root of the mass, and so does the horizon where several bodies are carried in the end.
        Where a gap is to be kept, routes replace the search.
        """
        names = "horizon", "starts", "clearance"
        horizon, starts, clearance = (getattr(task, name, None) for name in names)
        kinds = sorted(_SERVOS & set(task.scene.control_kind or ()))
        reason = f"the control is a {kinds[0] if kinds else 'force'}"
        default, bodies = 30 if kinds else 20, len(task.cost_terms().chain)
        several = bodies >= _SEVERAL and not kinds
        if several:
            default, reason = round(20 * np.sqrt(bodies / 2)), f"a force moves {bodies} bodies"
        reason = reason if None in (horizon, starts) else "the task says so"
        horizon = default if horizon is None else horizon
        if not getattr(cost, "contacts", True):
            horizon *= _HORIZON_WITHOUT_CONTACTS
        clearance = clearance if self.clearance is None else self.clearance
        routes = 0 if clearance is None or self.planner else _ROUTES
        routes = routes if self.routes is None else self.routes
        starts = (32 if kinds else 0) if starts is None else starts
        if routes or self.segment or self.planner or not searches(model):
            starts = 0
        return replace(
            self,
            horizon=horizon if self.horizon is None else self.horizon,
            starts=starts if self.starts is None else self.starts,
            routes=routes,
            clearance=clearance,
            leap=several if self.leap is None else self.leap,
            reason=reason if self.horizon is None else self.reason,
        )

    def made(self, task: Task, model: StepModel, limits: ControlLimits) -> Planner:
        """The planner, once all is `chosen`; a task's switches add their schedules."""
        assert self.horizon is not None
        if self.planner is not None:
            return self.planner(horizon=self.horizon, limits=limits)
        proposals: list[Proposal] = []
        if self.starts:
            proposals.append(Approaches(self.starts))
        if self.routes:
            proposals.append(Routes(self.routes))
        if self.segment:
            proposals.append(ShortPlans(self.segment))
        switches = switches_of(task.scene)
        for each in switches:
            constant = ConstantSchedule(each, False), ConstantSchedule(each, True)
            proposals += [*constant, ChangingSchedules(each)]
        if self.leap:
            proposals.append(Leap())
        if not proposals:
            return ILQR(self.horizon, self.iterations, limits)
        size = len(limits.lower)
        commands = getattr(getattr(model, "inference", None), "commands", 0)
        return MultiStartILQR(
            self.horizon,
            self.iterations + _LEAP_ROLLOUTS * bool(switches),
            limits,
            proposals=tuple(proposals),
            held=tuple(sorted({*switches, *range(size - commands, size)})),
            switching_cost=task.cost_terms().switching_cost,
        )


def task_policy(
    model: StepModel,
    task: Task,
    plans: Planning | None = None,
    *,
    seed: int = 0,
    cost: SceneCost | None = None,
    replan_every: int = 1,
    deadline: float | None = None,
    faults: SensorFault = EXACT,
    measured: bool = True,
    noise: ObservationNoise = NOISELESS,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
) -> MPCPolicy:
    """MPC with this model, for a task: a policy for `contactgraph.evaluate.control_task`.

    The task is reset to the scene of ``seed``, and the policy serves all its scenes. ``plans`` None
    are all `chosen`; ``cost`` None is the task's own; the limits of each component of the control
    are those of the task's action space. ``replan_every`` and ``motion_noise`` are `MPC`'s;
    ``deadline`` is in seconds; ``node_capacity`` is `MPCPolicy`'s.

    ``faults`` corrupts the contacts that the controller observes, and ``measured=False`` removes
    them; the recorded episodes keep the truth. The correction assumes the error rates of
    ``faults``, without faults the model's `default_sensor`. ``noise`` is added to the observed
    motion.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal or takes no
    control, or a number is out of range.
    """
    observation, _ = task.reset(seed=seed)
    limits = limits_of(task)
    control_size = len(limits.lower)
    check_fit(model, task.scene, control_size, "the task")
    terms = task.cost_terms()
    sensor = default_sensor(model) if faults.exact else faults.sensor
    plans = (plans or Planning()).chosen(task, model, cost)
    mpc = MPC(
        model,
        plans.made(task, model, limits),
        replace(sensor, reports_touch="holding" not in observation),
        replan_every,
        deadline,
        motion_noise=motion_noise,
    )
    candidates = terms.candidates if cost is None else ()
    if cost is None:
        turns = turn_length_of(model) is not None
        cost = TaskCost(terms, control_size, task.cost_terms, turns)
    return MPCPolicy(
        ActiveSetMPC(mpc), cost, node_capacity, faults, measured, noise, candidates, plans.clearance
    )


def limits_of(task: Task) -> ControlLimits:
    """[U] each; raises `InvalidInputError` where the task takes no control."""
    box: Any = task.action_space
    if not np.size(box.low):
        raise InvalidInputError("the task takes no control (U = 0), so nothing can control it")
    return ControlLimits(jnp.asarray(box.low.ravel()), jnp.asarray(box.high.ravel()))
