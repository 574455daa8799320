"""The fast loop: read, act by the newest plan's law, send."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.planner import (
    AsyncPlanner,
    EpisodeStart,
    PlanResult,
    TimedObservation,
)
from contactgraph_franka.loop.realtime import Clock, realtime_priority
from contactgraph_franka.loop.statistics import LoopReport, LoopStatistics
from contactgraph_franka.safety.filter import SafeRobot
from contactgraph_franka.safety.limits import SafetyLimits
from contactgraph_franka.safety.robot import Command, Robot, RobotReading, StopReason

OnTick = Callable[[float, RobotReading | None, np.ndarray | None], None]
"""Called in every tick with the time s, what was read (None: nothing new) and the force [D] N that
was really sent (None: none was). It must be quick."""

_BRAKING_S = 0.05
"""s, for which the loop goes on after a stop: until the force is off, then telling the robot to
brake in every tick, since a call may get lost."""
_FIRST_READING_S = 2.0
"""Wall seconds to wait for a robot's first reading."""


class ControlLoop:
    """Runs a plan's feedback at the rate of the arm, and plans beside it.

    In every tick the newest law answers to the newest reading, at the time that has passed since
    the moment it was made from. Every ``planning.interval`` planning is offered what was read and
    what was really sent, and plans from that when it has the time. No tick waits for it: a law that
    is older than ``longest_plan_age``, or over, gives no command, and the limits of the robot stop
    it gently (`StopReason.COMMAND_LATE`).
    """

    def __init__(
        self,
        robot: SafeRobot,
        planning: AsyncPlanner,
        clock: Clock,
        *,
        period: float = 0.001,
        longest_plan_age: float = 0.2,
        plan_deadline: float = 0.05,
    ) -> None:
        """All times in s on ``clock``, which must be the robot's.

        ``plan_deadline``: a plan that is there later than this after its moment counts as late; it
        is used all the same. Raises `InvalidInputError` where a time is not positive.
        """
        times = {"period": period, "longest_plan_age": longest_plan_age}
        for name, value in {**times, "plan_deadline": plan_deadline}.items():
            if not value > 0.0:
                raise InvalidInputError(f"{name} must be positive seconds, found {value}")
        self._robot = robot
        self._planning = planning
        self._clock = clock
        self._period = period
        self._longest_plan_age = longest_plan_age
        self._plan_deadline = plan_deadline

    def run(
        self,
        seconds: float,
        goal: np.ndarray,
        seed: int = 0,
        *,
        on_tick: OnTick | None = None,
        asked_to_stop: Callable[[], bool] = lambda: False,
    ) -> LoopReport:
        """Runs for ``seconds``, or until a limit or ``asked_to_stop`` ends it; always gently.

        ``goal`` [D] m and ``seed`` are for the planner. Raises `InvalidInputError` where the robot
        sends nothing to begin with, and, once the robot rests, whatever planning ended with.
        """
        reading = self._first_reading()
        self._planning.begin(EpisodeStart(reading, goal, seed))
        with realtime_priority():
            return self._run(reading, seconds, on_tick, asked_to_stop)

    def _first_reading(self) -> RobotReading:
        waited_until = time.monotonic() + _FIRST_READING_S
        while True:
            reading = self._robot.read()
            if reading is not None and _usable(reading, reading.position.shape):
                return reading
            if time.monotonic() > waited_until:
                raise InvalidInputError(
                    "the robot sends no reading to begin with, or one that is not finite"
                )
            self._clock.wait_until(self._clock() + self._period)

    def _run(
        self,
        reading: RobotReading,
        seconds: float,
        on_tick: OnTick | None,
        asked_to_stop: Callable[[], bool],
    ) -> LoopReport:
        robot, clock, planning, period = self._robot, self._clock, self._planning, self._period
        shape = reading.position.shape
        statistics = LoopStatistics(period, self._plan_deadline)
        running: PlanResult | None = None
        fault: Exception | None = None
        applied, sent_ticks = np.zeros(shape[1]), 0
        robot.reset()
        began = due = next_moment = clock()
        while True:
            clock.wait_until(due)
            now = clock()
            statistics.tick(now, due)
            due += period * (1 + max(0, int((now - due) / period)))
            news = robot.read()
            statistics.readings += news is not None
            if news is not None and _usable(news, shape):
                reading = news
            try:
                planned = planning.poll() if fault is None else None
            except Exception as error:  # whatever it is: first the robot is brought to rest
                planned, fault = None, error
            if planned is not None:
                statistics.planned(now, planned)
                running = planned if planned.law is not None else running
            if robot.stop is None:
                statistics.follows(now, running)
            sent = robot.send(self._command(running, reading, now))
            if on_tick is not None:
                on_tick(now, news, sent)
            if sent is not None:
                applied, sent_ticks = applied + sent, sent_ticks + 1
            accepted = robot.accepted
            if robot.stop is not None:
                if now - robot.stop.time > _BRAKING_S:
                    break
            elif fault is not None:
                robot.end(StopReason.PLANNER_FAILED)
            elif asked_to_stop():
                robot.end(StopReason.ASKED)
            elif now - began >= seconds:
                robot.end(StopReason.FINISHED)
            elif now >= next_moment - period / 2.0 and accepted is not None:
                planning.submit(TimedObservation(now, accepted, applied / max(1, sent_ticks)))
                applied, sent_ticks = np.zeros(shape[1]), 0
                # On the grid of steps that a model was made for, but never two in one tick.
                behind = int(max(0.0, now + period / 2.0 - next_moment) / planning.interval)
                next_moment += planning.interval * (1 + behind)
        if fault is not None:
            raise fault
        return statistics.report(robot.stop)

    def _command(
        self, running: PlanResult | None, reading: RobotReading, now: float
    ) -> Command | None:
        """None: there is nothing to do by. Before the first plan, the robot waits for it."""
        if running is None or running.law is None:
            return None
        elapsed = now - running.moment
        if elapsed > min(running.law.duration, self._longest_plan_age):
            return None
        return Command(running.law(elapsed, reading.position, reading.velocity), now)


def _usable(reading: RobotReading, shape: tuple[int, ...]) -> bool:
    """Whether a law can be asked with it; whether it is to be accepted is for the limits."""
    return (
        reading.position.shape == shape
        and bool(np.isfinite(reading.position).all())
        and bool(np.isfinite(reading.velocity).all())
    )


_STIFFNESS = 200.0
"""N/m"""
_DAMPING = 57.0
"""N s/m: critical for the hand's 4 kg."""
_LARGEST = 8.0
"""N: what pushes harder than this moves the hand."""


@dataclass(frozen=True)
class LoopTiming:
    """What `measure_loop` found; ms between states are on the robot's own clock."""

    report: LoopReport
    """Of the loop: its rate, and how late its ticks were."""
    states_hz: float
    """New states of the robot that the loop got, a second."""
    state_gap_ms_p50: float
    """From one of these to the next."""
    state_gap_ms_p99: float
    state_gap_ms_worst: float

    def lines(self) -> list[str]:
        """The same for people."""
        return [
            *(line for line in self.report.lines() if not line.startswith("plans")),
            f"states     {self.states_hz:.0f} Hz, the next after {self.state_gap_ms_p50:.2f} ms "
            f"median, {self.state_gap_ms_p99:.2f} ms 99 %, {self.state_gap_ms_worst:.2f} ms worst",
        ]


@dataclass(frozen=True, eq=False)
class PositionHold:
    """Holds the hand where it was, as a soft spring."""

    place: np.ndarray
    """[D] m"""
    duration: float
    """s"""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[D] N, at [N, D] m and m/s."""
        force = _STIFFNESS * (self.place - position[0]) - _DAMPING * velocity[0]
        return force * min(1.0, _LARGEST / max(float(np.linalg.norm(force)), 1e-9))


class PositionHoldPlanner:
    """AsyncPlanner that takes no time: the hand stays."""

    interval = 0.05
    """s"""

    def begin(self, start: EpisodeStart) -> None:
        """Where the hand is now is where it stays."""
        self._law = PositionHold(start.reading.position[0].copy(), duration=1.0)
        self._planned: PlanResult | None = None

    def submit(self, moment: TimedObservation) -> None:
        """Goes on."""
        self._planned = PlanResult(self._law, moment.time, 0.0)

    def poll(self) -> PlanResult | None:
        """The law, once for each moment."""
        planned, self._planned = self._planned, None
        return planned


def measure_loop(robot: Robot, limits: SafetyLimits, clock: Clock, seconds: float) -> LoopTiming:
    """Holds the hand for ``seconds`` with all that a tick needs: read, limits, law, send.

    ``clock`` must be the robot's. Raises `InvalidInputError` where ``seconds`` is not positive, or
    the robot sends nothing.
    """
    if not seconds > 0.0:
        raise InvalidInputError(f"seconds must be positive, found {seconds}")
    times: list[float] = []

    def note(now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        if reading is not None:
            times.append(reading.robot_time)

    loop = ControlLoop(SafeRobot(robot, limits, clock), PositionHoldPlanner(), clock)
    report = loop.run(seconds, np.zeros(len(limits.workspace_low)), on_tick=note)
    gaps = 1e3 * np.diff(times) if len(times) > 1 else np.full(1, np.nan)
    return LoopTiming(
        report=report,
        states_hz=len(times) / max(report.seconds, 1e-9),
        state_gap_ms_p50=float(np.percentile(gaps, 50)),
        state_gap_ms_p99=float(np.percentile(gaps, 99)),
        state_gap_ms_worst=float(gaps.max()),
    )
