"""What plans for a robot, and what it answers with. ``N`` nodes in ``D`` dimensions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import Policy
from contactgraph_franka.loop.laws import ZeroOrderHold
from contactgraph_franka.safety.robot import RobotReading


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """What a planner is told before a run."""

    reading: RobotReading
    goal: np.ndarray
    """[D] m"""
    seed: int = 0
    """Of whatever is random about the planner."""


@dataclass(frozen=True, eq=False)
class TimedObservation:
    """What a planner is told about one moment of a run."""

    time: float
    """s, on the loop's clock: a plan's law counts its seconds from here."""
    reading: RobotReading
    applied: np.ndarray
    """[D] N, the mean of what was really sent since the moment before: limits may have changed what
    was asked for, and feedback did."""


class ControlPolicy(Protocol):
    """What to do while no newer plan is there: cheap, since it is asked a thousand times a second.

    A law that comes late still acts right, because it is asked by the time that has passed since
    the moment it was made from, not since it came. It owns its numbers, and can be pickled; whoever
    runs the loop must have imported what it is made of: see `laws`.
    """

    @property
    def duration(self) -> float:
        """s, for which it has an answer."""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[D] N, ``elapsed`` s in [0, duration] after its moment, at [N, D] m and m/s."""


class Planner(Protocol):
    """Something that takes its time."""

    @property
    def interval(self) -> float:
        """s between the moments that it is told."""

    def begin(self, start: EpisodeStart) -> None:
        """Prepares for a run, and forgets the last one. May take long: nothing moves yet.

        Raises `InvalidInputError` where it cannot plan for what was read.
        """

    def plan(self, moments: Sequence[TimedObservation]) -> ControlPolicy | None:
        """The law from the last of ``moments`` on; None where no plan was found.

        ``moments`` are all since the last call, at least one: more than one where planning took
        longer than ``interval``.
        """


@dataclass(frozen=True, eq=False)
class PlanResult:
    """What planning from a moment came to."""

    law: ControlPolicy | None
    """None: no plan was found."""
    moment: float
    """s, on the loop's clock: what it was made from."""
    wall_s: float
    """Wall seconds that it took."""


class AsyncPlanner(Protocol):
    """A planner beside the loop."""

    @property
    def interval(self) -> float:
        """s between the moments that are to be offered."""

    def begin(self, start: EpisodeStart) -> None:
        """Prepares for a run; this alone may take long. Raises what `Planner.begin` raises."""

    def submit(self, moment: TimedObservation) -> None:
        """Something to plan from. Does not wait."""

    def poll(self) -> PlanResult | None:
        """What was planned since the last call. Does not wait; None: nothing yet.

        Raises whatever planning ended with for good.
        """


_HELD_STEPS = 5
"""After so many steps without a new force, the last one is over."""


class PolicyPlanner:
    """A `contactgraph_franka.loop.Planner` that asks a policy in every step of a scene."""

    def __init__(self, policy: Policy, scene: Scene) -> None:
        """``scene`` is that of all runs; each has its own goal."""
        self._policy, self._scene = policy, scene
        self.interval = float(scene.dt)
        """s"""

    def begin(self, start: EpisodeStart) -> None:
        """See `contactgraph_franka.loop.Planner`."""
        self._goal = start.goal
        self._policy.reset(replace(self._scene, goal=start.goal), start.seed)

    def plan(self, moments: Sequence[TimedObservation]) -> ZeroOrderHold:
        """See `contactgraph_franka.loop.Planner`. Policies count steps, so they hear of each."""
        forces = [self._policy(moment.reading.observation(self._goal)) for moment in moments]
        return ZeroOrderHold(np.asarray(forces[-1], dtype=np.float64), _HELD_STEPS * self.interval)
