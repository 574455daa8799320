"""What goes wrong with robots, to be injected into `FakeRobot`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph_franka.safety.robot import RobotReading

_DELAY = 5
"""Ticks."""
_JUMP = 0.1
"""m."""

Corruption = Callable[[Sequence[RobotReading], RobotReading], RobotReading | None]
"""What is read instead, from the true readings so far (newest last) and the one at the onset."""


def _intact(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    return past[-1]


def _nan(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    return replace(past[-1], position=np.full_like(past[-1].position, np.nan))


def _frozen(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    # What is frozen is what the robot tells; the host stamps it as ever.
    return replace(onset, time=past[-1].time)


def _jumped(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    position = past[-1].position.copy()
    position[-1] += _JUMP
    return replace(past[-1], position=position)


def _delayed(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    return past[max(len(past) - 1 - _DELAY, 0)]


def _unseen(past: Sequence[RobotReading], onset: RobotReading) -> RobotReading:
    tracked = past[-1].tracked.copy()
    tracked[-1] = False
    return replace(past[-1], tracked=tracked)


def _nothing(past: Sequence[RobotReading], onset: RobotReading) -> None:
    return None


@dataclass(frozen=True)
class Fault:
    """One kind of fault, from one tick to another."""

    start: int
    """The first tick it is there."""
    end: int
    """The first tick it is there no more."""
    corruption: Corruption = _intact
    deaf: bool = False
    """Whether the robot hears nothing."""
    late: bool = False
    """Whether plans come too late. A robot cannot make that happen: whoever plans asks for it."""

    def active(self, tick: int) -> bool:
        """Whether it is there in this tick."""
        return self.start <= tick < self.end


def nan_fault(start: int, end: int) -> Fault:
    """Positions are not numbers."""
    return Fault(start, end, _nan)


def frozen_fault(start: int, end: int) -> Fault:
    """The robot tells the same again and again, its clock included."""
    return Fault(start, end, _frozen)


def jump_fault(start: int, end: int) -> Fault:
    """The object is seen 0.1 m off on each axis."""
    return Fault(start, end, _jumped)


def delay_fault(start: int, end: int) -> Fault:
    """Readings come 5 ticks late."""
    return Fault(start, end, _delayed)


def lost_object_fault(start: int, end: int) -> Fault:
    """The object is tracked no more."""
    return Fault(start, end, _unseen)


def lost_packet_fault(start: int, end: int) -> Fault:
    """Nothing comes from the robot, and nothing reaches it."""
    return Fault(start, end, _nothing, deaf=True)


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
"""All kinds there are."""
