"""The fast loop: read, act by the newest plan's law, send."""

import time
from collections.abc import Callable

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop.clock import Clock
from contactgraph_franka.loop.planner import Moment, Start
from contactgraph_franka.loop.planning import Planned, Planning
from contactgraph_franka.loop.report import LoopReport
from contactgraph_franka.loop.tally import Tally
from contactgraph_franka.loop.undisturbed import undisturbed
from contactgraph_franka.robot.contract import Command, RobotReading
from contactgraph_franka.robot.safe_robot import SafeRobot
from contactgraph_franka.robot.stop import StopReason

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
        planning: Planning,
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
        self._planning.begin(Start(reading, goal, seed))
        with undisturbed():
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
        tally = Tally(period, self._plan_deadline)
        running: Planned | None = None
        fault: Exception | None = None
        applied, sent_ticks = np.zeros(shape[1]), 0
        robot.reset()
        began = due = next_moment = clock()
        while True:
            clock.wait_until(due)
            now = clock()
            tally.tick(now, due)
            due += period * (1 + max(0, int((now - due) / period)))
            news = robot.read()
            tally.readings += news is not None
            if news is not None and _usable(news, shape):
                reading = news
            try:
                planned = planning.done() if fault is None else None
            except Exception as error:  # whatever it is: first the robot is brought to rest
                planned, fault = None, error
            if planned is not None:
                tally.planned(now, planned)
                running = planned if planned.law is not None else running
            if robot.stop is None:
                tally.follows(now, running)
            sent = robot.send(self._command(running, reading, now))
            if on_tick is not None:
                on_tick(now, news, sent)
            if sent is not None:
                applied, sent_ticks = applied + sent, sent_ticks + 1
            believed = robot.believed
            if robot.stop is not None:
                if now - robot.stop.time > _BRAKING_S:
                    break
            elif fault is not None:
                robot.end(StopReason.PLANNER_FAILED)
            elif asked_to_stop():
                robot.end(StopReason.ASKED)
            elif now - began >= seconds:
                robot.end(StopReason.FINISHED)
            elif now >= next_moment - period / 2.0 and believed is not None:
                planning.offer(Moment(now, believed, applied / max(1, sent_ticks)))
                applied, sent_ticks = np.zeros(shape[1]), 0
                # On the grid of steps that a model was made for, but never two in one tick.
                behind = int(max(0.0, now + period / 2.0 - next_moment) / planning.interval)
                next_moment += planning.interval * (1 + behind)
        if fault is not None:
            raise fault
        return tally.report(robot.stop)

    def _command(
        self, running: Planned | None, reading: RobotReading, now: float
    ) -> Command | None:
        """None: there is nothing to do by. Before the first plan, the robot waits for it."""
        if running is None or running.law is None:
            return None
        elapsed = now - running.moment
        if elapsed > min(running.law.duration, self._longest_plan_age):
            return None
        return Command(running.law(elapsed, reading.position, reading.velocity), now)


def _usable(reading: RobotReading, shape: tuple[int, ...]) -> bool:
    """Whether a law can be asked with it; whether it is to be believed is for the limits."""
    return (
        reading.position.shape == shape
        and bool(np.isfinite(reading.position).all())
        and bool(np.isfinite(reading.velocity).all())
    )
