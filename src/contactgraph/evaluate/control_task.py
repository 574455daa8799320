"""Controllers in closed loop with a task: a model under MPC, or a scripted policy."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import gymnasium
import jax.numpy as jnp
import numpy as np

from contactgraph.control import (
    ILQR,
    ActiveSetMPC,
    ControlLimits,
    RecedingILQR,
    RouteILQR,
    SearchILQR,
    SwitchingILQR,
)
from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.envs.contract import Observation, Policy, Task
from contactgraph.envs.episodes import episode_seeds, run_episode
from contactgraph.evaluate.avoiding_cost import AvoidingCost
from contactgraph.evaluate.closed_loop import ClosedLoopMetrics, closed_loop_metrics
from contactgraph.evaluate.edge_scores import EstimatedContacts, estimated_contacts
from contactgraph.evaluate.mpc_policy import MPCPolicy
from contactgraph.evaluate.plan_tracking import (
    EpisodeRecord,
    PlanTrackingError,
    plan_tracking_error,
)
from contactgraph.evaluate.sensor_faults import ObservationNoise, SensorFaults
from contactgraph.evaluate.task_cost import SceneCost, TaskCost
from contactgraph.model import (
    ContactSensor,
    MotionNoise,
    StepModel,
    default_sensor,
    turn_length_of,
)
from contactgraph.model.scene import check_fit

_EXACT = SensorFaults()
_NOISELESS = ObservationNoise()
_LEAP_ROLLOUTS = 3
"""More rollouts for a plan with switches: a schedule that leaps pays after seven or eight only."""


def control_task(
    model: StepModel,
    task_factory: Callable[[], Task],
    episodes: int,
    seed: int,
    *,
    on_episode: Callable[[Trajectory, EpisodeRecord], None] | None = None,
    **options: Any,
) -> tuple[ClosedLoopMetrics, list[Trajectory]]:
    """Runs ``episodes`` episodes under `MPC` with this model, and measures them.

    ``options`` are those of `mpc_policy`. Episode ``i`` has the seed `collect` would give it. An
    episode that the task ends early is a failure unless the task calls it a success. ``on_episode``
    is called after each episode with the trajectory and the controller's record.

    Raises `InvalidInputError` as `mpc_policy`, and where a number is out of range.
    """
    seeds = episode_seeds(episodes, seed)
    task, observation = _first_scene(task_factory, seeds[0])
    policy = mpc_policy(model, task, observation, **options)
    plan_ms: list[np.ndarray] = []
    planned, estimated = PlanTrackingError(), EstimatedContacts()

    def judge(trajectory: Trajectory) -> None:
        nonlocal planned, estimated
        record, holding = policy.record(), trajectory.holding
        plan_ms.append(record.plan_ms)
        # Contacts as the policy's sensor reports them: see `MPCPolicy`.
        labelled = trajectory if holding is None else replace(trajectory, contact=holding)
        planned += plan_tracking_error(labelled, record)
        estimated += estimated_contacts(trajectory, record.estimated)
        if on_episode is not None:
            on_episode(trajectory, record)

    done = _run(policy, task, seeds, judge)
    times = np.concatenate(plan_ms)
    return closed_loop_metrics(*done, seed, times, planned, estimated, seeds), done[0]


def switches_of(scene: Scene) -> tuple[int, ...]:
    """The components of the control that are switches."""
    return tuple(each for each, kind in enumerate(scene.control_kind or ()) if kind == "switch")


def mpc_policy(
    model: StepModel,
    task: Task,
    observation: Observation,
    *,
    cost: SceneCost | None = None,
    horizon: int = 20,
    iterations: int = 5,
    starts: int = 0,
    routes: int = 0,
    segment: int = 0,
    clearance: float | None = None,
    replan_every: int = 1,
    deadline: float | None = None,
    sensor: ContactSensor | None = None,
    faults: SensorFaults = _EXACT,
    measured: bool = True,
    noise: ObservationNoise = _NOISELESS,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
) -> MPCPolicy:
    """The controller of `control_task`, for a task whose reset gave ``observation``.

    ``cost`` None is the task's own; the limits of each component of the control are those of the
    task's action space. ``horizon``, ``iterations`` and ``replan_every`` are `ILQR`'s and `MPC`'s,
    ``starts`` is `SearchILQR`'s, ``routes`` `RouteILQR`'s and ``segment`` `RecedingILQR`'s (0:
    none). ``clearance`` [m] adds an `AvoidingCost` with this gap to bodies that the task does not
    name. ``deadline`` is in seconds; ``node_capacity`` is `MPCPolicy`'s.

    ``faults`` corrupts the contacts that the controller observes, and ``measured=False`` removes
    them; the recorded episodes keep the truth. ``sensor`` has the error rates that the correction
    assumes, by default those of ``faults``, and without faults is the model's `default_sensor`.
    ``motion_noise`` is `MPC`'s; ``noise`` is added to the observed motion.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal or takes no
    control, a number is out of range, or there are more than one of switches, ``starts``,
    ``routes`` and ``segment``.
    """
    limits = _limits(task)
    control_size = len(limits.lower)
    check_fit(model, task.scene, control_size, "the task")
    terms = task.cost_terms()
    if sensor is None:
        sensor = default_sensor(model) if faults.exact else faults.sensor
    switches = switches_of(task.scene)
    if sum(map(bool, (starts, routes, segment, switches))) > 1:
        raise InvalidInputError(
            "a plan has one of starts, routes, a segment and a task's switches, found "
            f"starts {starts}, routes {routes}, segment {segment} and switches {list(switches)}"
        )
    ilqr = ILQR(horizon=horizon, iterations=iterations, limits=limits)
    if starts:
        ilqr = SearchILQR(
            horizon,
            iterations,
            limits,
            starts=starts,
            switching_cost=terms.switching_cost,
        )
    elif routes:
        speed = getattr(getattr(model, "features", None), "speed", 1.0)
        ilqr = RouteILQR(horizon, iterations, limits, routes=routes, speed=speed)
    elif segment:
        stride = next(each for each in (5, 4, 3, 2, 1) if horizon % each == 0 and each <= segment)
        ilqr = RecedingILQR(horizon, iterations, limits, segment=segment, stride=stride)
    elif switches:
        ilqr = SwitchingILQR(
            horizon,
            iterations + _LEAP_ROLLOUTS,
            limits,
            switches=switches,
            switching_cost=terms.switching_cost,
        )
    mpc = ActiveSetMPC(
        model,
        ilqr,
        replace(sensor, reports_touch="holding" not in observation),
        replan_every,
        deadline,
        motion_noise=motion_noise,
    )
    turns = turn_length_of(model) is not None
    own_cost = TaskCost.of(terms, control_size, task.cost_terms, turns)
    scene_cost, candidates = (own_cost, terms.candidates) if cost is None else (cost, ())
    if clearance is not None:
        scene_cost = AvoidingCost(scene_cost, clearance, candidates=candidates)
    size = scene_cost.in_scene(task.scene).quadratic(task.scene.node_count).control_size
    if size != control_size:  # before compilation
        raise InvalidInputError(
            f"the cost is for control size U {size}, but the task has {control_size}; they must "
            "agree"
        )
    return MPCPolicy(mpc, scene_cost, node_capacity, faults, measured, noise, candidates)


def control_by_policy(
    policy: Policy,
    task_factory: Callable[[], Task],
    episodes: int,
    seed: int,
    on_episode: Callable[[Trajectory], None] | None = None,
) -> tuple[ClosedLoopMetrics, list[Trajectory]]:
    """Runs a policy that neither predicts nor plans in the scenes of `control_task`.

    It is the baseline beside a model's success. Times of control steps, plans and estimates are
    not measured. Raises `InvalidInputError` where the task takes no control, or a number is out of
    range.
    """
    seeds = episode_seeds(episodes, seed)
    task, _ = _first_scene(task_factory, seeds[0])
    done = _run(policy, task, seeds, on_episode or (lambda trajectory: None))
    return closed_loop_metrics(*done, seed, scene_seeds=seeds), done[0]


def _run(
    policy: Policy, task: Task, seeds: Sequence[int], after: Callable[[Trajectory], None]
) -> tuple[list[Trajectory], list[bool], list[tuple[int, ...]]]:
    """An episode for each seed: what happened, whether it succeeded, and the chain of its cost."""
    trajectories, succeeded, chains = [], [], []
    for seed in seeds:
        trajectories.append(run_episode(task, policy, seed))
        succeeded.append(task.success())
        end, goal = trajectories[-1].position[-1], np.asarray(task.scene.goal)
        chains.append(task.cost_terms().ending_nearest(end, goal))
        after(trajectories[-1])
    return trajectories, succeeded, chains


def _first_scene(task_factory: Callable[[], Task], seed: int) -> tuple[Task, Observation]:
    """The task after a reset, from which on it knows its scene and cost."""
    task = task_factory()
    observation, _ = task.reset(seed=seed)
    _limits(task)
    return task, observation


def _limits(task: Task) -> ControlLimits:
    """[U] each; raises `InvalidInputError` where the task takes no control."""
    box = cast(gymnasium.spaces.Box, task.action_space)
    if not np.size(box.low):
        raise InvalidInputError("the task takes no control (U = 0), so nothing can control it")
    return ControlLimits(jnp.asarray(box.low.ravel()), jnp.asarray(box.high.ravel()))
