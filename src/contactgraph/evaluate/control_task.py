"""Policies in closed loop with a task: a model under MPC, a script, or one of your own."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.episodes import episode_seeds, run_episode
from contactgraph.evaluate.edge_scores import EstimatedContacts, estimated_contacts
from contactgraph.evaluate.plan_tracking import PlanTrackingError, plan_tracking_error
from contactgraph.evaluate.statistics import wilson_interval
from contactgraph.policies import EpisodeRecord, RecordingPolicy
from contactgraph.policies.task_policy import limits_of

_NO_TRACKING = PlanTrackingError()
_NO_ESTIMATES = EstimatedContacts()
_START_UP_S = 0.25
"""Time in which a gripper that starts at rest gains speed."""

EpisodeMetric = Callable[[Trajectory], float | None]
"""A metric of one's own: a number of an executed episode, None where it is not known."""


@dataclass(frozen=True)
class ClosedLoopMetrics:
    """The results of `closed_loop_metrics`; the names are the keys of `to_json`.

    Speeds are those of the gripper, the first node of the task's chain, over the episodes in
    which it touches the chain's next node. None: no episode determines a number.
    """

    episodes: int
    seed: int
    """Seed of the sequence of the episodes' seeds."""
    scenes: int
    """Distinct scenes among the episodes."""
    success_rate: float
    success_interval: tuple[float, float]
    """95 %, Wilson, over distinct scenes."""
    success_by_episode: tuple[bool, ...]
    goal_distance_m_median: float | None
    """From the chain's last node to the goal at the end of an episode, m."""
    goal_distance_m_mean: float | None
    contact_speed_m_s: float | None
    """Median speed in the last state before the first contact, m/s."""
    slowest_before_contact_min_m_s: float | None
    """The lowest speed of any episode from 0.25 s on to contact ("never stopping")."""
    touches_mean: float | None
    """Mean number of times in an episode that the gripper begins to touch the chain's next node."""
    touched_bystanders: int | None
    """Episodes in which a node of the chain touched a node outside it."""
    plan_ms_p50: float | None
    """Median time of a control step (correct, plan, return), ms."""
    plan_ms_p99: float | None
    planned: PlanTrackingError = field(default_factory=PlanTrackingError)
    """Planned against executed motion; its keys are beside the others in `to_json`."""
    estimated: EstimatedContacts = field(default_factory=EstimatedContacts)
    """Beliefs against true contacts; as above."""

    def to_json(self) -> dict[str, float | int | list[float | None] | None]:
        """All numbers by name."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        del numbers["planned"], numbers["estimated"]
        lists = {name: list(each) for name, each in numbers.items() if isinstance(each, tuple)}
        return {**numbers, **lists, **self.planned.to_json(), **self.estimated.to_json()}


@dataclass(frozen=True)
class ControlResult:
    """The episodes of a policy, and what is measured on them."""

    trajectories: Sequence[Trajectory]
    metrics: ClosedLoopMetrics
    by_episode: Mapping[str, Sequence[float | None]]
    """Further metrics by name, for each episode."""

    def to_json(self) -> dict[str, Any]:
        """All numbers by name; of a further metric the mean of what is known, and the list."""
        found: dict[str, Any] = {}
        for name, values in self.by_episode.items():
            known = [value for value in values if value is not None]
            found[name] = float(np.mean(known)) if known else None
            found[f"{name}_by_episode"] = list(values)
        return {**self.metrics.to_json(), **found}


def control_task(
    policy: Policy,
    task: Task,
    episodes: int,
    seed: int,
    *,
    metrics: Mapping[str, EpisodeMetric] | None = None,
    on_episode: Callable[[Trajectory, EpisodeRecord | None], None] | None = None,
) -> ControlResult:
    """Runs ``episodes`` episodes under a policy, and measures them.

    Episode ``i`` has the seed `collect` would give it. An episode that the task ends early is a
    failure unless the task calls it a success. Of a `RecordingPolicy`, such as that of
    `contactgraph.policies.task_policy`, times of control steps, plans and estimates of contacts are
    measured, too. ``metrics``: further ones by name. ``on_episode`` is called after each episode,
    with the record of such a policy.

    Raises `InvalidInputError` where the task takes no control, a number is out of range, or a
    metric has the name of a built-in one.
    """
    seeds = episode_seeds(episodes, seed)
    limits_of(task)  # a task that takes no control is refused
    trajectories: list[Trajectory] = []
    succeeded, chains, plan_ms = [], [], [np.zeros(0)]
    planned, estimated = PlanTrackingError(), EstimatedContacts()
    own = {name: list[float | None]() for name in metrics or {}}
    built_in = {each.name for each in fields(ClosedLoopMetrics)}
    taken = sorted(own.keys() & {*built_in, *planned.to_json(), *estimated.to_json()})
    if taken:
        raise InvalidInputError(f"metrics must have new names, found {taken[0]!r}")
    for each in seeds:
        trajectory = run_episode(task, policy, each)
        trajectories.append(trajectory)
        succeeded.append(task.success())
        end, goal = trajectory.position[-1], np.asarray(task.scene.goal)
        chains.append(task.cost_terms().ending_nearest(end, goal))
        record = policy.record() if isinstance(policy, RecordingPolicy) else None
        if record is not None:
            plan_ms.append(record.plan_ms)
            # Contacts as the policy's sensor reports them: see `MPCPolicy`.
            holding = trajectory.holding
            labelled = trajectory if holding is None else replace(trajectory, contact=holding)
            planned += plan_tracking_error(labelled, record)
            estimated += estimated_contacts(trajectory, record.estimated)
        for name, measure in (metrics or {}).items():
            own[name].append(measure(trajectory))
        if on_episode is not None:
            on_episode(trajectory, record)
    measured = closed_loop_metrics(
        trajectories,
        succeeded,
        chains,
        seed,
        plan_ms=np.concatenate(plan_ms),
        planned=planned,
        estimated=estimated,
        scene_seeds=seeds,
    )
    return ControlResult(trajectories, measured, own)


def closed_loop_metrics(
    trajectories: Sequence[Trajectory],
    succeeded: Sequence[bool],
    chains: Sequence[Sequence[int]],
    seed: int,
    plan_ms: Sequence[float] | np.ndarray = (),
    planned: PlanTrackingError = _NO_TRACKING,
    estimated: EstimatedContacts = _NO_ESTIMATES,
    scene_seeds: Sequence[int] | None = None,
) -> ClosedLoopMetrics:
    """Metrics of executed episodes.

    ``succeeded``: the task's own result for each. ``chains``: of each episode the task's nodes in
    order, gripper first. ``plan_ms``: the times of all control steps of all episodes, ms; none: not
    measured. ``planned`` and ``estimated``: the sums of the episodes' `plan_tracking_error` and
    `estimated_contacts`; none: not measured. ``scene_seeds``: one for each episode, equal in equal
    scenes; None: no scene is repeated.
    """
    episodes = list(zip(trajectories, chains, strict=True))
    numbers = range(len(trajectories)) if scene_seeds is None else scene_seeds
    distances = [found for each in episodes if (found := goal_distance(*each)) is not None]
    approaches = [one for each in episodes if (one := approach(*each)) is not None]
    slowest = [each for _, each in approaches if each is not None]
    touched = [_touched_distractor(*each) for each in episodes]
    touches = [found for each in episodes if (found := _touches(*each)) is not None]
    times = np.asarray(plan_ms, dtype=np.float64)
    return ClosedLoopMetrics(
        episodes=len(trajectories),
        seed=seed,
        scenes=len(set(numbers)),
        success_rate=sum(bool(each) for each in succeeded) / len(trajectories),
        success_interval=_success_interval(succeeded, numbers),
        success_by_episode=tuple(bool(each) for each in succeeded),
        goal_distance_m_median=_median(distances),
        goal_distance_m_mean=float(np.mean(distances)) if distances else None,
        contact_speed_m_s=_median([each for each, _ in approaches]),
        slowest_before_contact_min_m_s=min(slowest, default=None),
        touches_mean=float(np.mean(touches)) if touches else None,
        touched_bystanders=None if None in touched else sum(bool(each) for each in touched),
        plan_ms_p50=float(np.percentile(times, 50)) if times.size else None,
        plan_ms_p99=float(np.percentile(times, 99)) if times.size else None,
        planned=planned,
        estimated=estimated,
    )


def _touches(trajectory: Trajectory, chain: Sequence[int]) -> int | None:
    if trajectory.contact is None or len(chain) < 2:
        return None
    contact = trajectory.contact[:, chain[0], chain[1]]
    return int(contact[0]) + int(np.sum(contact[1:] & ~contact[:-1]))


def approach(trajectory: Trajectory, chain: Sequence[int]) -> tuple[float, float | None] | None:
    """m/s of the chain's first node in the last state before it touches the second, and its lowest
    speed after start-up and before that; None for the latter: it touches during start-up.

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
    return float(speed[-1]), slowest if first > start_up else None


def goal_distance(trajectory: Trajectory, chain: Sequence[int]) -> float | None:
    """m, from the chain's last node to the goal in the last state. None without a goal."""
    goal = trajectory.scene.goal
    if goal is None:
        return None
    return float(np.linalg.norm(trajectory.position[-1, chain[-1]] - goal))


def _success_interval(succeeded: Sequence[bool], scenes: Sequence[int]) -> tuple[float, float]:
    """A scene that is repeated is one trial, with the share of its successes."""
    results: dict[int, list[bool]] = {}
    for scene, each in zip(scenes, succeeded, strict=True):
        results.setdefault(scene, []).append(bool(each))
    successes = sum(sum(each) / len(each) for each in results.values())
    return wilson_interval(round(successes), len(results))


def _touched_distractor(trajectory: Trajectory, chain: Sequence[int]) -> bool | None:
    if trajectory.contact is None:
        return None
    member = np.isin(np.arange(trajectory.scene.node_count), chain)
    return bool(trajectory.contact[:, member][:, :, ~member].any())


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None
