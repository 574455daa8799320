"""MPC as the policy of a task: its planner, cost, sensor and limits."""

from collections.abc import Callable
from dataclasses import replace
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
    MultiStartILQR,
    Planner,
    Proposal,
    Routes,
    ShortPlans,
)
from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Task
from contactgraph.model import (
    MotionNoise,
    StepModel,
    default_sensor,
    turn_length_of,
)
from contactgraph.model.scene import check_fit
from contactgraph.policies.mpc_policy import MPCPolicy
from contactgraph.policies.sensor_faults import ObservationNoise, SensorFault, SensorFaults
from contactgraph.policies.task_cost import SceneCost, TaskCost, avoid_others

PlannerFactory = Callable[..., Planner]
"""Called with the keywords ``horizon`` [steps] and ``limits``, a `ControlLimits`."""

_EXACT = SensorFaults()
_NOISELESS = ObservationNoise()
_SERVOS = {"position", "displacement", "velocity"}
_LEAP_ROLLOUTS = 3
"""More rollouts for a plan with switches: a schedule that leaps pays after seven or eight only."""


def switches_of(scene: Scene) -> tuple[int, ...]:
    """The components of the control that are switches."""
    return tuple(each for each, kind in enumerate(scene.control_kind or ()) if kind == "switch")


def planning(task: Task) -> tuple[int, int, str]:
    """Horizon [steps] and starts of plans in a task that has begun an episode, and why.

    What its attributes ``horizon`` and ``starts`` do not give follows from what is controlled: a
    servo, or a displacement, pushes and cannot pull, so a plan is long and begins with a search for
    the side to push from. Forces act on what is touched and held, where iLQR needs neither.
    """
    horizon, starts = (getattr(task, name, None) for name in ("horizon", "starts"))
    kinds = sorted(_SERVOS & set(task.scene.control_kind or ()))
    reason = f"the control is a {kinds[0]}" if kinds else "the control is a force"
    if horizon is not None and starts is not None:
        reason = "the task says so"
    default_horizon, default_starts = (30, 64) if kinds else (20, 0)
    return (
        default_horizon if horizon is None else horizon,
        default_starts if starts is None else starts,
        reason,
    )


def task_policy(
    model: StepModel,
    task: Task,
    *,
    seed: int = 0,
    cost: SceneCost | None = None,
    horizon: int = 20,
    iterations: int = 5,
    starts: int = 0,
    routes: int = 0,
    segment: int = 0,
    clearance: float | None = None,
    replan_every: int = 1,
    deadline: float | None = None,
    faults: SensorFault = _EXACT,
    measured: bool = True,
    noise: ObservationNoise = _NOISELESS,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
    planner: PlannerFactory | None = None,
) -> MPCPolicy:
    """MPC with this model, for a task: a policy for `contactgraph.evaluate.control_task`.

    The task is reset to the scene of ``seed``, and the policy serves all its scenes.
    ``cost`` None is the task's own; the limits of each component of the control are those of the
    task's action space. ``horizon``, ``iterations`` and ``replan_every`` are `ILQR`'s and `MPC`'s,
    ``starts``, ``routes`` and ``segment`` those of `Approaches`, `Routes` and `ShortPlans` (0:
    none). ``planner`` makes another planner in place of all of these, by the keywords ``horizon``
    and ``limits``. ``clearance`` [m] is the gap to be kept from bodies that the task does not name,
    0 forbids touches alone, None neither. ``deadline`` is in seconds; ``node_capacity`` is
    `MPCPolicy`'s.

    ``faults`` corrupts the contacts that the controller observes, and ``measured=False`` removes
    them; the recorded episodes keep the truth. The correction assumes the error rates of
    ``faults``, without faults the model's `default_sensor`. ``motion_noise`` is `MPC`'s; ``noise``
    is added to the observed motion.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal or takes no
    control, or a number is out of range.
    """
    observation, _ = task.reset(seed=seed)
    limits = limits_of(task)
    control_size = len(limits.lower)
    check_fit(model, task.scene, control_size, "the task")
    terms = task.cost_terms()
    sensor = default_sensor(model) if faults.exact else faults.sensor
    if planner is None:
        made = _planner(model, task, horizon, iterations, limits, starts, routes, segment)
    else:
        made = planner(horizon=horizon, limits=limits)
    mpc = MPC(
        model,
        made,
        replace(sensor, reports_touch="holding" not in observation),
        replan_every,
        deadline,
        motion_noise=motion_noise,
    )
    candidates = terms.candidates if cost is None else ()
    if cost is None:
        turns = turn_length_of(model) is not None
        cost = TaskCost(terms, control_size, task.cost_terms, turns)
    size = cost.in_scene(task.scene).quadratic(task.scene.node_count).control_size
    if size != control_size:  # before compilation
        raise InvalidInputError(
            f"the cost is for control size U {size}, but the task has {control_size}; they must "
            "agree"
        )
    if clearance is not None:
        avoid_others(task.scene, terms.chain, clearance)
    return MPCPolicy(
        ActiveSetMPC(mpc), cost, node_capacity, faults, measured, noise, candidates, clearance
    )


def _planner(
    model: StepModel,
    task: Task,
    horizon: int,
    iterations: int,
    limits: ControlLimits,
    starts: int,
    routes: int,
    segment: int,
) -> Planner:
    """Of the options of `task_policy`; a task's switches add their schedules."""
    proposals: list[Proposal] = []
    if starts:
        proposals.append(Approaches(starts))
    if routes:
        speed = getattr(getattr(model, "features", None), "speed", 1.0)
        proposals.append(Routes(routes, speed))
    if segment:
        stride = next(each for each in (5, 4, 3, 2, 1) if horizon % each == 0 and each <= segment)
        proposals.append(ShortPlans(segment, stride))
    switches = switches_of(task.scene)
    for each in switches:
        constant = ConstantSchedule(each, False), ConstantSchedule(each, True)
        proposals += [*constant, ChangingSchedules(each)]
    size = len(limits.lower)
    commands = getattr(getattr(model, "inference", None), "commands", 0)
    if not proposals:
        return ILQR(horizon, iterations, limits)
    return MultiStartILQR(
        horizon,
        iterations + _LEAP_ROLLOUTS * bool(switches),
        limits,
        proposals=tuple(proposals),
        held=tuple(sorted({*switches, *range(size - commands, size)})),
        switching_cost=task.cost_terms().switching_cost,
    )


def limits_of(task: Task) -> ControlLimits:
    """[U] each; raises `InvalidInputError` where the task takes no control."""
    box: Any = task.action_space
    if not np.size(box.low):
        raise InvalidInputError("the task takes no control (U = 0), so nothing can control it")
    return ControlLimits(jnp.asarray(box.low.ravel()), jnp.asarray(box.high.ravel()))
