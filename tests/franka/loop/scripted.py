"""Planners that do as they are told, and time that does, too."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop import (
    Clock,
    ControlPolicy,
    EpisodeStart,
    Planner,
    PlanResult,
    TimedObservation,
)
from contactgraph_franka.safety import FakeRobot, RobotReading


@dataclass(frozen=True)
class Push:
    """The same force for a while."""

    force: tuple[float, float, float] = (1.0, 0.0, 0.0)
    duration: float = 0.5

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.array(self.force)


@dataclass(frozen=True)
class ByTime:
    """As many newtons as seconds since the run began, whenever it was planned."""

    moment: float
    duration: float = 0.5

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.array([self.moment + elapsed, 0.0, 0.0])


class Scripted:
    """A planner that answers with whatever it is given to answer with."""

    interval = 0.01

    def __init__(self, answer: Callable[[TimedObservation], ControlPolicy | None]) -> None:
        self.answer = answer
        self.told: list[TimedObservation] = []
        self.start: EpisodeStart | None = None

    def reset(self, start: EpisodeStart) -> None:
        self.start = start
        self.told = []

    def plan(self, moments: Sequence[TimedObservation]) -> ControlPolicy | None:
        self.told += moments
        return self.answer(moments[-1])


def sleeper() -> Scripted:
    """Takes 120 ms for a plan."""

    def answer(moment: TimedObservation) -> ControlPolicy:
        time.sleep(0.12)
        return Push()

    return Scripted(answer)


def busy() -> Scripted:
    """Computes in Python for 20 ms a plan."""

    def answer(moment: TimedObservation) -> ControlPolicy:
        until = time.perf_counter() + 0.02
        while time.perf_counter() < until:
            pass
        return Push()

    return Scripted(answer)


def stuck() -> Scripted:
    """Does not come back from its fifth plan."""
    count = [0]

    def answer(moment: TimedObservation) -> ControlPolicy:
        count[0] += 1
        if count[0] == 5:
            time.sleep(60.0)
        return Push()

    return Scripted(answer)


def broken() -> Scripted:
    def answer(moment: TimedObservation) -> ControlPolicy:
        raise ZeroDivisionError("the planner's own fault")

    return Scripted(answer)


def dying() -> Scripted:
    def answer(moment: TimedObservation) -> ControlPolicy:
        raise SystemExit(3)

    return Scripted(answer)


class Refusing(Scripted):
    """Cannot plan for what it is told."""

    def __init__(self) -> None:
        super().__init__(lambda moment: Push())

    def reset(self, start: EpisodeStart) -> None:
        raise InvalidInputError(f"no plan leads to {start.goal.tolist()}")


def unmakeable() -> Scripted:
    raise InvalidInputError("there is no such model")


class StepTime:
    """Time that passes only while somebody waits, and moves the fake robot."""

    def __init__(self, robot: FakeRobot) -> None:
        self.robot = robot

    def __call__(self) -> float:
        return self.robot.clock()

    def wait_until(self, moment: float) -> None:
        while self.robot.clock() < moment - 1e-9:
            self.robot.advance()


class Delayed:
    """AsyncPlanner that takes so many seconds of simulated time, without a process."""

    def __init__(self, planner: Planner, clock: Clock, delay: float = 0.0) -> None:
        self.interval = planner.interval
        self._planner, self._clock, self._delay = planner, clock, delay
        self._coming: list[tuple[float, PlanResult]] = []

    def reset(self, start: EpisodeStart) -> None:
        self._planner.reset(start)
        self._coming = []

    def submit(self, moment: TimedObservation) -> None:
        planned = PlanResult(self._planner.plan([moment]), moment.time, self._delay)
        self._coming.append((self._clock() + self._delay, planned))

    def poll(self) -> PlanResult | None:
        if self._coming and self._coming[0][0] <= self._clock() + 1e-9:
            return self._coming.pop(0)[1]
        return None


class Diary:
    """What each tick saw and sent."""

    def __init__(self) -> None:
        self.time: list[float] = []
        self.sent: list[np.ndarray | None] = []

    def __call__(self, now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        self.time.append(now)
        self.sent.append(sent)

    @property
    def push(self) -> np.ndarray:
        """[T] N along x; 0 where nothing was sent."""
        return np.array([0.0 if sent is None else sent[0] for sent in self.sent])
