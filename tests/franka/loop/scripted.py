"""Planners with scripted answers, and a clock that advances the fake robot."""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop import (
    Clock,
    ControlPolicy,
    EpisodeStart,
    PlanFeedback,
    Planner,
    PlanResult,
    TimedObservation,
)
from contactgraph_franka.safety import FakeRobot, RobotReading


@dataclass(frozen=True)
class ConstantForce:
    """The same force for ``duration`` s."""

    force: tuple[float, float, float] = (1.0, 0.0, 0.0)
    duration: float = 0.5

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.array(self.force)


@dataclass(frozen=True)
class TimeAsForce:
    """As many newtons as the loop's clock shows seconds, whenever it was planned."""

    observed_at: float
    duration: float = 0.5

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.array([self.observed_at + elapsed, 0.0, 0.0])


class Scripted:
    """A planner that answers by a given function of the last observation."""

    interval = 0.01

    def __init__(self, answer: Callable[[TimedObservation], ControlPolicy | None]) -> None:
        self.answer = answer
        self.observations: list[TimedObservation] = []
        self.start: EpisodeStart | None = None

    def reset(self, start: EpisodeStart) -> None:
        self.start = start
        self.observations = []

    def plan(self, observations: Sequence[TimedObservation]) -> ControlPolicy | None:
        self.observations += observations
        return self.answer(observations[-1])


def slow(seconds: float = 0.12, first: int = 1) -> Scripted:
    """A planner that sleeps for ``seconds`` a plan, from plan ``first`` on."""
    count = itertools.count(1)

    def answer(observation: TimedObservation) -> ControlPolicy:
        if next(count) >= first:
            time.sleep(seconds)
        return ConstantForce()

    return Scripted(answer)


def busy() -> Scripted:
    """A planner that computes in Python for 20 ms a plan."""

    def answer(observation: TimedObservation) -> ControlPolicy:
        until = time.perf_counter() + 0.02
        while time.perf_counter() < until:
            pass
        return ConstantForce()

    return Scripted(answer)


def failing(error: BaseException) -> Scripted:
    """A planner whose plans raise ``error``."""

    def answer(observation: TimedObservation) -> ControlPolicy:
        raise error

    return Scripted(answer)


class Refusing(Scripted):
    """A planner that cannot plan for any episode."""

    def __init__(self) -> None:
        super().__init__(lambda observation: ConstantForce())

    def reset(self, start: EpisodeStart) -> None:
        raise InvalidInputError(f"no plan leads to {start.goal.tolist()}")


def unmakeable() -> Scripted:
    raise InvalidInputError("there is no such model")


def feedback_planner(path: Path, max_force: float, options: object) -> Scripted:
    """In place of the commands' MPC: a `PlanFeedback` without gains that pushes along y."""
    states = np.zeros((21, 2, 2, 3))
    plan = PlanFeedback(states, np.tile([0.0, 3.0, 0.0], (20, 1)), np.zeros((20, 3, 2, 2, 3)), 0.02)
    return Scripted(lambda _: plan)


class StepTime:
    """A clock that advances, and simulates the fake robot, only while something waits for it."""

    def __init__(self, robot: FakeRobot) -> None:
        self.robot = robot

    def __call__(self) -> float:
        return self.robot.clock()

    def wait_until(self, until: float) -> None:
        while self.robot.clock() < until - 1e-9:
            self.robot.advance()


class Delayed:
    """An `AsyncPlanner` in this process, whose plans come ``delay`` s of ``clock`` late."""

    def __init__(self, planner: Planner, clock: Clock, delay: float = 0.0) -> None:
        self.interval = planner.interval
        self._planner, self._clock, self._delay = planner, clock, delay
        self._pending: list[tuple[float, PlanResult]] = []

    def reset(self, start: EpisodeStart) -> None:
        self._planner.reset(start)
        self._pending = []

    def submit(self, observation: TimedObservation) -> None:
        result = PlanResult(self._planner.plan([observation]), observation.time, self._delay)
        self._pending.append((self._clock() + self._delay, result))

    def poll(self) -> PlanResult | None:
        if self._pending and self._pending[0][0] <= self._clock() + 1e-9:
            return self._pending.pop(0)[1]
        return None


class CycleLog:
    """Times and sent forces of all cycles."""

    def __init__(self) -> None:
        self.time: list[float] = []
        self.sent: list[np.ndarray | None] = []

    def __call__(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        self.time.append(now)
        self.sent.append(sent)

    @property
    def force(self) -> np.ndarray:
        """[T] N along x; 0 where nothing was sent."""
        return np.array([0.0 if sent is None else sent[0] for sent in self.sent])
