"""The safety filter between every controller and every robot.

`rejection_reason` checks a reading, `SafetyFilter` limits a command, and `SafeRobot` is the only
way to a robot: it sends nothing but what the filter lets pass.
"""

import math
from collections.abc import Callable

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.safety.limits import (
    SafetyLimits,
    apply_virtual_walls,
    clip_norm,
    limit_rate,
)
from contactgraph_franka.safety.robot import Command, Robot, RobotReading, Stop, StopReason

_ABSURD = 1e12
"""m, m/s or s: beyond any valid reading, and small enough for its square to be a float. Clocks that
count from 1970 are below it."""
_JITTER = 1e-9
"""s: rounding of clocks, which are floating point numbers."""
_NO_NEWS = (StopReason.CONNECTION_LOST, StopReason.READING_FROZEN)
"""Rejections under which the last reading still counts: a loop may be faster than the robot."""


def rejection_reason(
    reading: RobotReading | None,
    last: RobotReading | None,
    now: float,
    hand: int,
    limits: SafetyLimits,
) -> StopReason | None:
    """Why ``reading`` is rejected at the time ``now`` s; None where it is accepted.

    ``last`` is the last accepted reading, ``hand`` the index of the actuated node.
    """
    if reading is None:
        return StopReason.CONNECTION_LOST
    dimension = len(limits.workspace_low)
    if reading.position.shape[1] != dimension or not hand < len(reading.position):
        return StopReason.READING_UNFIT
    if last is not None and reading.position.shape != last.position.shape:
        return StopReason.READING_UNFIT
    if not reading.tracked.all():
        return StopReason.OBJECT_LOST
    if not _finite(reading):
        return StopReason.READING_NOT_FINITE
    longest = np.full(len(reading.time), limits.longest_track_age)
    longest[hand] = limits.longest_age
    # A time stamp from the future is rejected like an old one.
    if np.any(np.abs(now - reading.time) > longest):
        return StopReason.READING_STALE
    if last is not None and reading.robot_time <= last.robot_time:
        return StopReason.READING_FROZEN
    if last is not None and _jumped(reading, last, limits):
        return StopReason.POSITION_JUMPED
    return None


def _finite(reading: RobotReading) -> bool:
    values = (reading.position, reading.velocity, reading.time)
    return all(bool((np.abs(value) < _ABSURD).all()) for value in values) and math.isfinite(
        reading.robot_time
    )


def _jumped(reading: RobotReading, last: RobotReading, limits: SafetyLimits) -> bool:
    elapsed = np.maximum(reading.time - last.time, 0.0)
    moved = np.sqrt(np.sum((reading.position - last.position) ** 2, axis=1))
    return bool(np.any(moved > limits.largest_jump + limits.max_speed * elapsed))


class SafetyFilter:
    """Turns any command and reading into a force that is finite and within limits.

    It is called once a control cycle with the newest command and the newest reading. A rejected
    reading eases the force off at once; where no reading comes, the last one counts. Both stop the
    robot where they last longer than ``longest_age``, so that one lost packet is no stop. A command
    that is not finite stops the robot at once, a missing one after ``longest_gap``.

    A stop is gentle: the force goes to zero at its largest rate and stays there until `reset`.
    The robot's own brake, which needs no reading, then ends the remaining motion (`eased`).
    """

    def __init__(self, limits: SafetyLimits, now: float, hand: int = 0) -> None:
        """``now`` s on the clock of all later calls; ``hand`` is the index of the actuated node.

        Raises `InvalidInputError` where ``hand`` is negative.
        """
        if hand < 0:
            raise InvalidInputError(f"hand must be the index of a node, found {hand}")
        self.limits = limits
        self._hand = hand
        self.eased = True
        self.reset(now)

    def reset(self, now: float) -> None:
        """Ends a stop at ``now`` s, and forgets its reason and all readings and commands.

        The force continues from its present value, which is zero once the robot braked by itself.
        """
        self.stop: Stop | None = None
        if self.eased:
            self._force = np.zeros(len(self.limits.workspace_low))
            self._previous_force = self._force
        self.eased = False
        """Whether a stop has brought the force to zero, so that the robot's brake may act."""
        self._now = now
        self._accepted_at = now
        self._sent_at = now
        self._previous_sent_at = now
        self._commanded_at: float | None = None
        self.accepted: RobotReading | None = None
        """The reading used by the last call: the newest accepted one."""
        self._reading: RobotReading | None = None
        self._command: np.ndarray | None = None

    def __call__(
        self, command: Command | None, reading: RobotReading | None, now: float
    ) -> np.ndarray:
        """The force ``[D]`` N to send at the time ``now`` s.

        ``command`` and ``reading`` are None where none has come since the last call.
        """
        duration = now - self._now
        if not duration >= 0.0 or math.isinf(duration):
            self.halt(StopReason.CLOCK_BROKEN, self._now)
            # Without time no rate can be kept: the robot's own brake stops the motion.
            self.eased = True
            return self._force.copy()
        self._now = now
        if duration > self.limits.longest_gap + _JITTER:
            self.halt(StopReason.LOOP_LATE, now)
        self.accepted = self._take_reading(reading, now)
        self._take_command(command, now)
        if now - self._sent_at > self.limits.longest_gap + _JITTER:
            self.halt(StopReason.CONNECTION_LOST, now)

        target = self._target(self.accepted)
        # After a pause the force may not make up for all of the lost time at once.
        duration = min(duration, self.limits.longest_gap)
        self._previous_force = self._force
        self._force = limit_rate(self._force, target, duration, self.limits)
        self.eased = self.eased or (self.stop is not None and not self._force.any())
        self._previous_sent_at, self._sent_at = self._sent_at, now
        return self._force.copy()

    def halt(self, reason: StopReason, now: float) -> None:
        """Stops at ``now`` s; the first reason counts."""
        if self.stop is None:
            self.stop = Stop(reason, now)

    def sent(self, force: np.ndarray | None) -> None:
        """Takes in the force that the robot reports as sent, ``[D]`` N; None where it got lost.

        The next force follows that one, if it is valid. A robot that cannot be reached cannot be
        stopped gently.
        """
        if force is None:
            self._force, self._sent_at = self._previous_force, self._previous_sent_at
            self.eased = self.stop is not None
        elif np.shape(force) == self._force.shape and np.isfinite(force).all():
            self._force = clip_norm(np.array(force, dtype=np.float64), self.limits.max_force)

    def _target(self, accepted: RobotReading | None) -> np.ndarray:
        if self.stop is not None or self._command is None or accepted is None:
            return np.zeros_like(self._force)
        position, velocity = accepted.position[self._hand], accepted.velocity[self._hand]
        return apply_virtual_walls(self._command, position, velocity, self.limits)

    def _take_reading(self, reading: RobotReading | None, now: float) -> RobotReading | None:
        limits = self.limits
        reason = rejection_reason(reading, self._reading, now, self._hand, limits)
        if reason is not None:
            if now - self._accepted_at > limits.longest_age + _JITTER:
                self.halt(reason, now)
            return self._reading if reason in _NO_NEWS else None
        assert reading is not None
        self._reading = reading
        self._accepted_at = now
        position, velocity = reading.position[self._hand], reading.velocity[self._hand]
        if np.any(position < limits.workspace_low) or np.any(position > limits.workspace_high):
            self.halt(StopReason.OUTSIDE_WORKSPACE, now)
        elif math.hypot(*velocity) > limits.max_speed:
            self.halt(StopReason.TOO_FAST, now)
        return reading

    def _take_command(self, command: Command | None, now: float) -> None:
        if command is not None:
            force = np.array(command.force)
            usable = force.shape == self._force.shape and force.dtype.kind in "fiu"
            if not usable or not np.isfinite(force).all() or not command.time <= now:
                self.halt(StopReason.COMMAND_UNUSABLE, now)
                return
            self._command = force
            self._commanded_at = command.time
        commanded = self._commanded_at
        # Before the first command, the robot waits for as long as it takes.
        if commanded is not None and now - commanded > self.limits.longest_gap + _JITTER:
            self.halt(StopReason.COMMAND_LATE, now)


class SafeRobot:
    """Access of a controller to a robot, through its limits: `read`, then `send`, once a cycle.

    After a stop the force is eased off, then the robot brakes by itself, until `reset`.
    """

    def __init__(
        self, robot: Robot, limits: SafetyLimits, clock: Callable[[], float], hand: int = 0
    ) -> None:
        """``clock`` gives the time in s of readings and commands; `time.monotonic` for an arm.

        ``hand`` is the index of the actuated node.
        """
        self._robot = robot
        self._clock = clock
        self._filter = SafetyFilter(limits, clock(), hand)
        self._reading: RobotReading | None = None

    @property
    def stop(self) -> Stop | None:
        """Why and when the robot was stopped; None while it may move."""
        return self._filter.stop

    @property
    def accepted(self) -> RobotReading | None:
        """The newest reading accepted by the last `send`; None where there is none."""
        return self._filter.accepted

    def end(self, reason: StopReason) -> None:
        """Stops the robot on request: the next calls ease the force off, then brake."""
        self._filter.halt(reason, self._clock())

    def reset(self) -> None:
        """Lets a stopped robot move again, and starts all deadlines: call it before a loop."""
        self._robot.resume()
        self._reading = None
        self._filter.reset(self._clock())

    def read(self) -> RobotReading | None:
        """The newest reading, accepted or not; None where none has come since the last call."""
        self._reading = self._robot.read()
        return self._reading

    def send(self, command: Command | None) -> np.ndarray | None:
        """Sends a command within the limits, or the last one where it is None.

        Returns the force ``[D]`` N really sent; None where nothing was.
        """
        now = self._clock()
        force = self._filter(command, self._reading, now)
        if self._filter.stop is not None and self._filter.eased:
            self._robot.stop(self._filter.stop)
            return None
        sent = self._robot.send(force, now)
        if sent is None and self._robot.ended is not None:
            self._filter.halt(self._robot.ended.reason, now)
        self._filter.sent(sent)
        return sent
