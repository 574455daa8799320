"""Interfaces of planners and of the policies that they return. ``N`` nodes in ``D`` dimensions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from contactgraph_franka.safety.robot import RobotReading

if TYPE_CHECKING:
    from contactgraph.data import Scene
    from contactgraph.envs.contract import Policy

_HELD_STEPS = 5
"""Steps for which a policy's force counts where no newer one comes."""


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """Input of a planner before an episode."""

    reading: RobotReading
    goal: np.ndarray
    """[D] m"""
    seed: int = 0
    """Seed of a planner's random numbers."""


@dataclass(frozen=True, eq=False)
class TimedObservation:
    """Input of a planner at one time of an episode."""

    time: float
    """s, on the loop's clock: a plan's time counts from here."""
    reading: RobotReading
    applied: np.ndarray
    """[D] N, the mean force really sent since the previous observation. It differs from the plan's
    by feedback and by limits."""


class ControlPolicy(Protocol):
    """A plan's control at any time within it. Called in every control cycle, so it must be fast.

    A plan that arrives late still acts right, because it is evaluated at the time since its
    observation, not since its arrival. It must own its data and be picklable, and its class be in a
    module that the loop's process has imported.
    """

    @property
    def duration(self) -> float:
        """s, after which the policy gives no control."""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[D] N, ``elapsed`` s in [0, duration] after its observation, at [N, D] m and m/s."""


@dataclass(frozen=True, eq=False)
class ZeroOrderHold:
    """A `ControlPolicy`: a constant force."""

    force: np.ndarray
    """[D] N"""
    duration: float
    """s"""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The force."""
        return self.force


class Planner(Protocol):
    """A planner that may take longer than a control cycle."""

    @property
    def interval(self) -> float:
        """s between observations."""

    def reset(self, start: EpisodeStart) -> None:
        """Prepares for an episode, and forgets the last one. May take long: nothing moves yet.

        Raises `InvalidInputError` where it cannot plan from ``start``.
        """

    def plan(self, observations: Sequence[TimedObservation]) -> ControlPolicy | None:
        """The policy from the last observation on; None where no plan was found.

        ``observations`` are all since the last call, at least one: more than one where planning
        took longer than ``interval``.
        """


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Result of one call of `Planner.plan`."""

    policy: ControlPolicy | None
    """None: no plan was found."""
    observed_at: float
    """s, on the loop's clock: the time of the observation that it was made from."""
    wall_s: float
    """Wall seconds of planning."""


class AsyncPlanner(Protocol):
    """A planner that runs beside the control loop, and never blocks it."""

    @property
    def interval(self) -> float:
        """s between the observations to submit."""

    def reset(self, start: EpisodeStart) -> None:
        """Prepares for an episode; only this call may take long. Raises what the planner does."""

    def submit(self, observation: TimedObservation) -> None:
        """Hands over an observation to plan from. Does not block."""

    def poll(self) -> PlanResult | None:
        """The plan made since the last call; None where there is none. Does not block.

        Raises the error that ended planning for good.
        """


class PolicyPlanner:
    """A `Planner` that calls a task's policy, such as a scripted expert, in every step."""

    def __init__(self, policy: "Policy", scene: "Scene") -> None:
        """``scene`` is that of all episodes; each has its own goal."""
        self._policy, self._scene = policy, scene
        self.interval = float(scene.dt)
        """s"""

    def reset(self, start: EpisodeStart) -> None:
        """See `Planner`."""
        self._goal = start.goal
        self._policy.reset(replace(self._scene, goal=start.goal), start.seed)

    def plan(self, observations: Sequence[TimedObservation]) -> ZeroOrderHold:
        """See `Planner`. The policy is called on each observation, since it may count steps."""
        forces = [self._policy(each.reading.observation(self._goal)) for each in observations]
        return ZeroOrderHold(np.asarray(forces[-1], dtype=np.float64), _HELD_STEPS * self.interval)
