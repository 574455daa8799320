"""How well a controller does a task: success, speed at contact, what else it touched, time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.evaluate.found_contacts import FoundContacts
from contactgraph.evaluate.planned_error import PlannedError
from contactgraph.evaluate.statistics import wilson_interval

_NOTHING_PLANNED = PlannedError()
_NOTHING_FOUND = FoundContacts()
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
    planned: PlannedError = field(default_factory=PlannedError)
    """Plans against what came of them; its keys stand beside the others in `to_json`."""
    found: FoundContacts = field(default_factory=FoundContacts)
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
    planned: PlannedError = _NOTHING_PLANNED,
    found: FoundContacts = _NOTHING_FOUND,
) -> ClosedLoopMetrics:
    """Metrics of executed episodes.

    ``succeeded``: the task's own verdict on each. ``chain``: the task's nodes in order, gripper
    first. ``plan_ms``: the times of all control ticks of all episodes, ms; none: not measured.
    ``planned`` and ``found``: the sums of the episodes' `planned_error` and `found_contacts`; none:
    not measured.
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
