"""The control loop: it reads, evaluates the newest plan and sends, a thousand times a second."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.feedback import PlanFeedback
from contactgraph_franka.loop.planner import (
    AsyncPlanner,
    EpisodeStart,
    PlanResult,
    TimedObservation,
)
from contactgraph_franka.loop.realtime import Clock, realtime_priority
from contactgraph_franka.loop.statistics import LoopReport, LoopStatistics, LoopTiming
from contactgraph_franka.safety.filter import SafeRobot
from contactgraph_franka.safety.limits import SafetyLimits
from contactgraph_franka.safety.robot import Command, Robot, RobotReading, StopReason

CycleCallback = Callable[[float, RobotReading | None, np.ndarray | None], None]
"""Called in every cycle with the time s, the reading (None: nothing new) and the force [D] N really
sent (None: none was). It must be fast."""

PlanCallback = Callable[[float, PlanResult], None]
"""Called with each plan, and the time s from the begin of the episode to its observation."""

_BRAKING_S = 0.05
"""s, for which the loop goes on after a stop: until the force is off, and then calling the robot's
brake in every cycle, since a call may get lost."""
_FIRST_READING_S = 2.0
"""Wall seconds to wait for a robot's first reading."""
_HOLD_STIFFNESS = 200.0
"""N/m"""
_HOLD_DAMPING = 57.0
"""N s/m: critical for the hand's 4 kg."""
_HOLD_FORCE = 8.0
"""N: a larger external force moves the hand."""


class ControlLoop:
    """Evaluates a plan's policy at the rate of the arm, while a planner runs beside it.

    In every cycle the newest policy is evaluated at the newest reading and at the time since its
    observation. Every ``planner.interval`` the planner is given the reading and the mean force
    really sent. No cycle waits for it: a policy older than ``longest_plan_age``, or past its end,
    gives no command, and the robot's limits stop it gently (`StopReason.COMMAND_LATE`).
    """

    def __init__(
        self,
        robot: SafeRobot,
        planner: AsyncPlanner,
        clock: Clock,
        *,
        period: float = 0.001,
        longest_plan_age: float = 0.2,
        plan_deadline: float = 0.05,
    ) -> None:
        """All times are in s on ``clock``, which must be the robot's.

        A plan that comes later than ``plan_deadline`` after its observation counts as late; it is
        used all the same. Raises `InvalidInputError` where a time is not positive.
        """
        times = {"period": period, "longest_plan_age": longest_plan_age}
        for name, value in {**times, "plan_deadline": plan_deadline}.items():
            if not value > 0.0:
                raise InvalidInputError(f"{name} must be positive seconds, found {value}")
        self._robot = robot
        self._planner = planner
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
        on_cycle: CycleCallback | None = None,
        on_plan: PlanCallback | None = None,
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> LoopReport:
        """Runs for ``seconds``, or until a limit or ``stop_requested`` ends it; always gently.

        ``goal`` [D] m and ``seed`` are for the planner. Raises `InvalidInputError` where the robot
        sends no first reading, and the planner's error once the robot is at rest.
        """
        reading = self._first_reading()
        self._planner.reset(EpisodeStart(reading, goal, seed))
        with realtime_priority():
            return self._run(reading, seconds, on_cycle, on_plan, stop_requested)

    def _first_reading(self) -> RobotReading:
        until = time.monotonic() + _FIRST_READING_S
        while True:
            reading = self._robot.read()
            if reading is not None and _is_finite(reading, reading.position.shape):
                return reading
            if time.monotonic() > until:
                raise InvalidInputError(
                    "the robot sends no reading to begin with, or one that is not finite"
                )
            self._clock.wait_until(self._clock() + self._period)

    def _run(
        self,
        reading: RobotReading,
        seconds: float,
        on_cycle: CycleCallback | None,
        on_plan: PlanCallback | None,
        stop_requested: Callable[[], bool],
    ) -> LoopReport:
        robot, clock, planner, period = self._robot, self._clock, self._planner, self._period
        shape = reading.position.shape
        statistics = LoopStatistics(period, self._plan_deadline)
        active: PlanResult | None = None
        fault: Exception | None = None
        applied, sent_cycles = np.zeros(shape[1]), 0
        robot.reset()
        began = due = next_observation = clock()
        while True:
            clock.wait_until(due)
            now = clock()
            statistics.add_cycle(now, due)
            due += period * (1 + max(0, int((now - due) / period)))
            new_reading = robot.read()
            statistics.readings += new_reading is not None
            if new_reading is not None and _is_finite(new_reading, shape):
                reading = new_reading
            try:
                result = planner.poll() if fault is None else None
            except Exception as error:  # of any class: the robot is brought to rest first
                result, fault = None, error
            if result is not None:
                statistics.add_plan(now, result)
                if on_plan is not None:
                    on_plan(result.observed_at - began, result)
                active = result if result.policy is not None else active
            if robot.stop is None:
                statistics.add_plan_age(now, active)
            sent = robot.send(self._command(active, reading, now))
            if on_cycle is not None:
                on_cycle(now, new_reading, sent)
            if sent is not None:
                applied, sent_cycles = applied + sent, sent_cycles + 1
            accepted = robot.accepted
            if robot.stop is not None:
                if now - robot.stop.time > _BRAKING_S:
                    break
            elif fault is not None:
                robot.end(StopReason.PLANNER_FAILED)
            elif stop_requested():
                robot.end(StopReason.ASKED)
            elif now - began >= seconds:
                robot.end(StopReason.FINISHED)
            elif now >= next_observation - period / 2.0 and accepted is not None:
                planner.submit(TimedObservation(now, accepted, applied / max(1, sent_cycles)))
                applied, sent_cycles = np.zeros(shape[1]), 0
                # On the grid of the model's steps, but never two in one cycle.
                behind = int(max(0.0, now + period / 2.0 - next_observation) / planner.interval)
                next_observation += planner.interval * (1 + behind)
        if fault is not None:
            raise fault
        return statistics.report(robot.stop)

    def _command(
        self, active: PlanResult | None, reading: RobotReading, now: float
    ) -> Command | None:
        """None where no plan is valid. The robot waits for the first plan."""
        if active is None or active.policy is None:
            return None
        elapsed = now - active.observed_at
        if elapsed > min(active.policy.duration, self._longest_plan_age):
            return None
        return Command(active.policy(elapsed, reading.position, reading.velocity), now)


def _is_finite(reading: RobotReading, shape: tuple[int, ...]) -> bool:
    """Whether a policy can be evaluated at it; the limits decide whether it is accepted."""
    return (
        reading.position.shape == shape
        and bool(np.isfinite(reading.position).all())
        and bool(np.isfinite(reading.velocity).all())
    )


class PositionHoldPlanner:
    """An `AsyncPlanner` that takes no time.

    It holds the hand at its first position by a soft spring and damper.
    """

    interval = 0.05
    """s"""

    def reset(self, start: EpisodeStart) -> None:
        """Takes the present position of the hand as the target."""
        position = start.reading.position
        state = np.stack([position, np.zeros_like(position)], axis=1)
        gains = np.zeros((1, position.shape[1], *state.shape))
        for part, gain in enumerate((_HOLD_STIFFNESS, _HOLD_DAMPING)):
            gains[0, :, 0, part] = -gain * np.eye(position.shape[1])
        held = np.stack([state, state])
        self._policy = PlanFeedback(held, np.zeros((1, position.shape[1])), gains, dt=1.0)
        self._result: PlanResult | None = None

    def submit(self, observation: TimedObservation) -> None:
        """See `AsyncPlanner`."""
        self._result = PlanResult(self._policy, observation.time, 0.0)

    def poll(self) -> PlanResult | None:
        """The policy, once for each observation."""
        result, self._result = self._result, None
        return result


def measure_loop(robot: Robot, limits: SafetyLimits, clock: Clock, seconds: float) -> LoopTiming:
    """Measures the timing of robot and loop over ``seconds``, while the hand is held in position.

    Each cycle does all that control needs: read, limit, evaluate, send. ``clock`` must be the
    robot's. Raises `InvalidInputError` where ``seconds`` is not positive, or the robot sends
    nothing.
    """
    if not seconds > 0.0:
        raise InvalidInputError(f"seconds must be positive, found {seconds}")
    times: list[float] = []

    def add_time(now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        if reading is not None:
            times.append(reading.robot_time)

    limits = replace(limits, max_force=min(limits.max_force, _HOLD_FORCE))
    loop = ControlLoop(SafeRobot(robot, limits, clock), PositionHoldPlanner(), clock)
    report = loop.run(seconds, np.zeros(len(limits.workspace_low)), on_cycle=add_time)
    gaps = 1e3 * np.diff(times) if len(times) > 1 else np.full(1, np.nan)
    return LoopTiming(
        report=report,
        states_hz=len(times) / max(report.seconds, 1e-9),
        state_gap_ms_p50=float(np.percentile(gaps, 50)),
        state_gap_ms_p99=float(np.percentile(gaps, 99)),
        state_gap_ms_worst=float(gaps.max()),
    )
