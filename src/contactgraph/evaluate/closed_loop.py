"""A model in closed loop with a task, and the metrics of the executed episodes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import cast

import gymnasium
import jax.numpy as jnp
import numpy as np

from contactgraph.control import ILQR, ActiveSetMPC, ControlLimits
from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.envs.contract import Task
from contactgraph.envs.episodes import episode_seeds, run_episode
from contactgraph.evaluate.edge_scores import EstimatedContacts, estimated_contacts
from contactgraph.evaluate.mpc_policy import MPCPolicy, SceneCost, TaskCost
from contactgraph.evaluate.plan_tracking import (
    EpisodeRecord,
    PlanTrackingError,
    plan_tracking_error,
)
from contactgraph.evaluate.sensor_faults import ObservationNoise, SensorFaults
from contactgraph.evaluate.statistics import wilson_interval
from contactgraph.model import ContactSensor, MotionNoise, StepModel
from contactgraph.model.filter import check_fit

_NO_TRACKING = PlanTrackingError()
_NO_ESTIMATES = EstimatedContacts()
_START_UP_S = 0.25
"""Time in which a gripper that starts at rest gains speed."""


@dataclass(frozen=True)
class ClosedLoopMetrics:
    """The results of `closed_loop_metrics`; the names are the keys of `to_json`.

    Speeds are those of the gripper, the first node of the task's chain, over the episodes in
    which it touches the chain's next node. None: no episode determines a number.
    """

    episodes: int
    seed: int
    """Seed of the sequence of the episodes' seeds."""
    success_rate: float
    success_interval: tuple[float, float]
    """95 %, Wilson."""
    contact_speed_m_s: float | None
    """Median speed in the last state before the first contact, m/s."""
    slowest_before_contact_m_s: float | None
    """Median of each episode's lowest speed from 0.25 s on to contact ("never stopping")."""
    slowest_before_contact_min_m_s: float | None
    """The lowest such speed of any episode."""
    touched_bystanders: int | None
    """Episodes in which a node of the chain touched a node outside it."""
    plan_ms_p50: float | None
    """Median time of a control step (correct, plan, return), ms."""
    plan_ms_p99: float | None
    planned: PlanTrackingError = field(default_factory=PlanTrackingError)
    """Planned against executed motion; its keys are beside the others in `to_json`."""
    estimated: EstimatedContacts = field(default_factory=EstimatedContacts)
    """Beliefs against true contacts; as above."""

    def to_json(self) -> dict[str, float | int | list[float] | None]:
        """All numbers by name."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        del numbers["planned"], numbers["estimated"]
        interval = list(self.success_interval)
        parts = {**self.planned.to_json(), **self.estimated.to_json()}
        return {**numbers, "success_interval": interval, **parts}


@dataclass(frozen=True)
class Approach:
    """The gripper's approach to its first contact in one episode."""

    contact_speed: float
    """In the last state before contact, m/s."""
    slowest: float | None
    """Lowest speed after start-up and before contact, m/s. None: contact during start-up."""


def closed_loop_metrics(
    trajectories: Sequence[Trajectory],
    succeeded: Sequence[bool],
    chain: Sequence[int],
    seed: int,
    plan_ms: Sequence[float] | np.ndarray = (),
    planned: PlanTrackingError = _NO_TRACKING,
    estimated: EstimatedContacts = _NO_ESTIMATES,
) -> ClosedLoopMetrics:
    """Metrics of executed episodes.

    ``succeeded``: the task's own result for each. ``chain``: the task's nodes in order, gripper
    first. ``plan_ms``: the times of all control steps of all episodes, ms; none: not measured.
    ``planned`` and ``estimated``: the sums of the episodes' `plan_tracking_error` and
    `estimated_contacts`; none: not measured.
    Raises `InvalidInputError` where there is no episode, ``succeeded`` has another length, or
    an episode lacks a node of the chain.
    """
    if not trajectories or len(succeeded) != len(trajectories):
        raise InvalidInputError(
            f"succeeded must have one entry an episode, at least one, found {len(succeeded)} for "
            f"{len(trajectories)} episodes"
        )
    fewest = min(each.scene.node_count for each in trajectories)
    if not chain or not 0 <= min(chain) <= max(chain) < fewest:
        raise InvalidInputError(f"chain must name nodes 0 to {fewest - 1}, found {tuple(chain)}")
    successes = sum(bool(each) for each in succeeded)
    approaches = [found for each in trajectories if (found := approach(each, chain)) is not None]
    slowest = [each.slowest for each in approaches if each.slowest is not None]
    touched = [_touched_distractor(each, chain) for each in trajectories]
    times = np.asarray(plan_ms, dtype=np.float64)
    return ClosedLoopMetrics(
        episodes=len(trajectories),
        seed=seed,
        success_rate=successes / len(trajectories),
        success_interval=wilson_interval(successes, len(trajectories)),
        contact_speed_m_s=_median([each.contact_speed for each in approaches]),
        slowest_before_contact_m_s=_median(slowest),
        slowest_before_contact_min_m_s=min(slowest, default=None),
        touched_bystanders=None if None in touched else sum(bool(each) for each in touched),
        plan_ms_p50=float(np.percentile(times, 50)) if times.size else None,
        plan_ms_p99=float(np.percentile(times, 99)) if times.size else None,
        planned=planned,
        estimated=estimated,
    )


def approach(trajectory: Trajectory, chain: Sequence[int]) -> Approach | None:
    """The chain's first node's approach to its second.

    None where it never does, touches it from the start, contacts were not recorded, or the chain
    has one node.
    """
    if trajectory.contact is None or len(chain) < 2:
        return None
    touching = trajectory.contact[:, chain[0], chain[1]]
    first = int(np.argmax(touching))
    if first == 0:
        return None
    speed = np.linalg.norm(trajectory.velocity[:first, chain[0]], axis=-1)
    start_up = round(_START_UP_S / trajectory.scene.dt)
    slowest = float(speed[start_up:].min(initial=math.inf))
    return Approach(float(speed[-1]), slowest if first > start_up else None)


def _touched_distractor(trajectory: Trajectory, chain: Sequence[int]) -> bool | None:
    if trajectory.contact is None:
        return None
    member = np.isin(np.arange(trajectory.scene.node_count), chain)
    return bool(trajectory.contact[:, member][:, :, ~member].any())


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


_EXACT = SensorFaults()
_NOISELESS = ObservationNoise()


def control_task(
    model: StepModel,
    task_factory: Callable[[], Task],
    episodes: int,
    seed: int,
    *,
    cost: SceneCost | None = None,
    horizon: int = 20,
    iterations: int = 5,
    replan_every: int = 1,
    deadline: float | None = None,
    sensor: ContactSensor | None = None,
    faults: SensorFaults = _EXACT,
    measured: bool = True,
    noise: ObservationNoise = _NOISELESS,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
    on_episode: Callable[[Trajectory, EpisodeRecord], None] | None = None,
) -> tuple[ClosedLoopMetrics, list[Trajectory]]:
    """Runs ``episodes`` episodes under `MPC` with this model, and measures them.

    ``cost`` None is the task's own; the force limits are its action space's. Episode ``i`` has the
    seed `collect` would give it. ``horizon``, ``iterations`` and ``replan_every`` are `ILQR`'s
    and `MPC`'s, ``deadline`` is in seconds; ``node_capacity`` is `MPCPolicy`'s. ``on_episode`` is
    called after each episode with the trajectory and the controller's record.

    ``faults`` corrupts the contacts that the controller observes, and ``measured=False`` removes
    them; the recorded episodes keep the truth. ``sensor`` has the error rates that the correction
    assumes, by default those of ``faults``. ``motion_noise`` is `MPC`'s: with it, beliefs are also
    corrected by the observed motion, to which ``noise`` is added.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal, or a number
    is out of range.
    """
    seeds = episode_seeds(episodes, seed)
    task = task_factory()
    # The scene, and with it the cost's chain, is known after a reset.
    task.reset(seed=seeds[0])
    box = cast(gymnasium.spaces.Box, task.action_space)
    control_size = int(np.prod(box.shape))
    check_fit(model, task.scene, control_size, "the task")
    terms = task.cost_terms()
    limits = ControlLimits(jnp.asarray(box.low), jnp.asarray(box.high))
    ilqr = ILQR(horizon=horizon, iterations=iterations, limits=limits)
    mpc = ActiveSetMPC(
        model,
        ilqr,
        sensor or faults.sensor,
        replan_every,
        deadline,
        motion_noise=motion_noise,
    )
    scene_cost = TaskCost.of(terms, control_size) if cost is None else cost
    _check_cost(scene_cost, task, control_size)
    policy = MPCPolicy(mpc, scene_cost, node_capacity, faults, measured, noise)

    trajectories: list[Trajectory] = []
    succeeded: list[bool] = []
    plan_ms: list[np.ndarray] = []
    planned, estimated = PlanTrackingError(), EstimatedContacts()
    for episode_seed in seeds:
        trajectories.append(run_episode(task, policy, episode_seed))
        succeeded.append(task.success())
        record = policy.record()
        plan_ms.append(record.plan_ms)
        planned += plan_tracking_error(trajectories[-1], record)
        estimated += estimated_contacts(trajectories[-1], record.estimated)
        if on_episode is not None:
            on_episode(trajectories[-1], record)
    metrics = closed_loop_metrics(
        trajectories, succeeded, terms.chain, seed, np.concatenate(plan_ms), planned, estimated
    )
    return metrics, trajectories


def _check_cost(cost: SceneCost, task: Task, control_size: int) -> None:
    """Raises `InvalidInputError`, before compilation, where cost and task do not fit."""
    size = cost.in_scene(task.scene).quadratic(task.scene.node_count).control_size
    if size != control_size:
        raise InvalidInputError(
            f"the cost is for control size U {size}, but the task has {control_size}; they must "
            "agree"
        )
