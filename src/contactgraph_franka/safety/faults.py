"""Faults of robots, sensors and planners, for injection into `FakeRobot`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph_franka.safety.robot import RobotReading

_DELAY = 5
"""Control cycles."""
_JUMP = 0.1
"""m."""

Corruption = Callable[[Sequence[RobotReading], RobotReading], RobotReading | None]
"""The faulty reading, from the true readings so far (newest last) and the one at the onset."""


def _intact(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    return past[-1]


@dataclass(frozen=True)
class Fault:
    """One fault, in the control cycles from ``start`` up to but not including ``end``."""

    start: int
    end: int
    corruption: Corruption = _intact
    drops_commands: bool = False
    """Whether commands do not reach the robot."""
    late: bool = False
    """Whether plans come too late; the test's controller asks for this, not the robot."""

    def active(self, cycle: int) -> bool:
        """Whether the fault is present in this cycle."""
        return self.start <= cycle < self.end


def nan_fault(start: int, end: int) -> Fault:
    """Positions are NaN."""
    return Fault(
        start,
        end,
        lambda past, _: replace(past[-1], position=np.full_like(past[-1].position, np.nan)),
    )


def frozen_fault(start: int, end: int) -> Fault:
    """The robot repeats one reading, its clock included; the host stamps it as usual."""
    return Fault(start, end, lambda past, onset: replace(onset, time=past[-1].time))


def jump_fault(start: int, end: int) -> Fault:
    """The object's position is 0.1 m off on each axis."""
    off = np.array([[0.0], [_JUMP]])
    return Fault(start, end, lambda past, _: replace(past[-1], position=past[-1].position + off))


def delay_fault(start: int, end: int) -> Fault:
    """Readings come 5 control cycles late."""
    return Fault(start, end, lambda past, _: past[max(len(past) - 1 - _DELAY, 0)])


def lost_object_fault(start: int, end: int) -> Fault:
    """The object is no longer tracked."""
    return Fault(start, end, lambda past, _: replace(past[-1], tracked=np.array([True, False])))


def lost_packet_fault(start: int, end: int) -> Fault:
    """No reading comes from the robot, and no command reaches it."""
    return Fault(start, end, lambda past, onset: None, drops_commands=True)


def late_plan_fault(start: int, end: int) -> Fault:
    """The controller has no new command."""
    return Fault(start, end, late=True)


FAULTS = (
    nan_fault,
    frozen_fault,
    jump_fault,
    delay_fault,
    lost_object_fault,
    lost_packet_fault,
    late_plan_fault,
)
"""All faults."""
