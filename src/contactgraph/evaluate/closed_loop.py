"""How well a controller does a task: success, speed at contact, what else it touched, time."""

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

_NOTHING_PLANNED = PlanTrackingError()
_NOTHING_FOUND = EstimatedContacts()
_START_UP_S = 0.25
"""In which a gripper that starts at rest gains speed."""


@dataclass(frozen=True)
class ClosedLoopMetrics:
    """What `closed_loop_metrics` measures; the names are the keys of `to_json`.

    Speeds are those of the gripper, the first node of the task's chain, over the episodes in
    which it touches the chain's next node. None: no episode tells.
    """

    episodes: int
    seed: int
    """From which the episodes' seeds were spawned."""
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
    """Median time of a control tick (correct, plan, hand over), ms."""
    plan_ms_p99: float | None
    planned: PlanTrackingError = field(default_factory=PlanTrackingError)
    """Plans against what came of them; its keys stand beside the others in `to_json`."""
    found: EstimatedContacts = field(default_factory=EstimatedContacts)
    """Beliefs against contacts, as they were; as above."""

    def to_json(self) -> dict[str, float | int | list[float] | None]:
        """All numbers by name."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        del numbers["planned"], numbers["found"]
        interval = list(self.success_interval)
        told = {**self.planned.to_json(), **self.found.to_json()}
        return {**numbers, "success_interval": interval, **told}


@dataclass(frozen=True)
class Approach:
    """How the gripper came to its first contact in one episode."""

    contact_speed: float
    """In the last state before contact, m/s."""
    slowest: float | None
    """Lowest speed after start-up and before contact, m/s. None: contact came in start-up."""


def closed_loop_metrics(
    trajectories: Sequence[Trajectory],
    succeeded: Sequence[bool],
    chain: Sequence[int],
    seed: int,
    plan_ms: Sequence[float] | np.ndarray = (),
    planned: PlanTrackingError = _NOTHING_PLANNED,
    found: EstimatedContacts = _NOTHING_FOUND,
) -> ClosedLoopMetrics:
    """Metrics of executed episodes.

    ``succeeded``: the task's own verdict on each. ``chain``: the task's nodes in order, gripper
    first. ``plan_ms``: the times of all control ticks of all episodes, ms; none: not measured.
    ``planned`` and ``found``: the sums of the episodes' `plan_tracking_error` and
    `estimated_contacts`; none: not measured.
    Raises `InvalidInputError` where there is no episode, verdicts do not match the episodes, or
    an episode lacks a node of the chain.
    """
    if not trajectories or len(succeeded) != len(trajectories):
        raise InvalidInputError(
            f"succeeded must have one entry an episode, at least one, found {len(succeeded)} for "
            f"{len(trajectories)} episodes"
        )
    fewest = min(run.scene.node_count for run in trajectories)
    if not chain or not 0 <= min(chain) <= max(chain) < fewest:
        raise InvalidInputError(f"chain must name nodes 0 to {fewest - 1}, found {tuple(chain)}")
    successes = sum(bool(each) for each in succeeded)
    approaches = [each for run in trajectories if (each := approach(run, chain)) is not None]
    slowest = [each.slowest for each in approaches if each.slowest is not None]
    touched = [_touched_bystander(run, chain) for run in trajectories]
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
        found=found,
    )


def approach(run: Trajectory, chain: Sequence[int]) -> Approach | None:
    """How the chain's first node came to touch its second.

    None where it never does, touches it from the start, contacts were not recorded, or the chain
    has one node.
    """
    if run.contact is None or len(chain) < 2:
        return None
    touching = run.contact[:, chain[0], chain[1]]
    first = int(np.argmax(touching))
    if first == 0:
        return None
    speed = np.linalg.norm(run.velocity[:first, chain[0]], axis=-1)
    start_up = round(_START_UP_S / run.scene.dt)
    slowest = float(speed[start_up:].min(initial=math.inf))
    return Approach(float(speed[-1]), slowest if first > start_up else None)


def _touched_bystander(run: Trajectory, chain: Sequence[int]) -> bool | None:
    if run.contact is None:
        return None
    member = np.isin(np.arange(run.scene.node_count), chain)
    return bool(run.contact[:, member][:, :, ~member].any())


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


_EXACT = SensorFaults()
_CLEAR = ObservationNoise()


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
    noise: ObservationNoise = _CLEAR,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
    on_episode: Callable[[Trajectory, EpisodeRecord], None] | None = None,
) -> tuple[ClosedLoopMetrics, list[Trajectory]]:
    """Runs ``episodes`` episodes under `MPC` with this model, and measures them.

    ``cost`` None is the task's own; the force limits are its action space's. Episode ``i`` has the
    seed `collect` would give it. ``horizon``, ``iterations`` and ``replan_every`` are `ILQR`'s
    and `MPC`'s, ``deadline`` is in seconds; ``node_capacity`` is `MPCPolicy`'s. ``on_episode`` is
    called after each episode with what was done and what the controller thought.

    ``faults`` spoils the contacts that the controller observes, and ``measured=False`` keeps all
    of them from it; the recorded episodes keep the truth. ``sensor`` is what the correction is
    told of error rates, by default those of ``faults``. ``motion_noise`` is `MPC`'s: with it,
    beliefs are corrected by the motion observed, too, on which there is ``noise``.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal, or a number
    is out of range.
    """
    seeds = episode_seeds(episodes, seed)
    task = task_factory()
    # The scene, and with it the cost's chain, is known once an episode has begun.
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
    wanted = TaskCost.of(terms, control_size) if cost is None else cost
    _check_cost(wanted, task, control_size)
    policy = MPCPolicy(mpc, wanted, node_capacity, faults, measured, noise)

    runs: list[Trajectory] = []
    succeeded: list[bool] = []
    plan_ms: list[np.ndarray] = []
    planned, found = PlanTrackingError(), EstimatedContacts()
    for episode_seed in seeds:
        runs.append(run_episode(task, policy, episode_seed))
        succeeded.append(task.success())
        record = policy.record()
        plan_ms.append(record.plan_ms)
        planned += plan_tracking_error(runs[-1], record)
        found += estimated_contacts(runs[-1], record.found)
        if on_episode is not None:
            on_episode(runs[-1], record)
    metrics = closed_loop_metrics(
        runs, succeeded, terms.chain, seed, np.concatenate(plan_ms), planned, found
    )
    return metrics, runs


def _check_cost(cost: SceneCost, task: Task, control_size: int) -> None:
    """Before anything is compiled: whether the cost is about this task at all."""
    found = cost.in_scene(task.scene).quadratic(task.scene.node_count).control_size
    if found != control_size:
        raise InvalidInputError(
            f"the cost is for control size U {found}, but the task has {control_size}; they must "
            "agree"
        )
