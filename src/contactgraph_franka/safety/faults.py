"""Faults of robots, sensors and planners, for injection into `FakeRobot`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

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


_Maker = Callable[[int, int], Fault]


def _changed(change: Callable[[RobotReading], dict[str, Any]]) -> _Maker:
    """Makes faults of fields of the newest reading."""
    return partial(Fault, corruption=lambda past, _: replace(past[-1], **change(past[-1])))


nan_fault = _changed(lambda true: {"position": np.full_like(true.position, np.nan)})
"""Positions are NaN."""
frozen_fault = partial(Fault, corruption=lambda past, onset: replace(onset, time=past[-1].time))
"""The robot repeats one reading, its clock included; the host stamps it as usual."""
jump_fault = _changed(lambda true: {"position": true.position + np.array([[0.0], [_JUMP]])})
"""The object's position is 0.1 m off on each axis."""
delay_fault = partial(Fault, corruption=lambda past, _: past[max(len(past) - 1 - _DELAY, 0)])
"""Readings come 5 control cycles late."""
lost_object_fault = _changed(lambda _: {"tracked": np.array([True, False])})
"""The object is no longer tracked."""
lost_packet_fault = partial(Fault, corruption=lambda past, onset: None, drops_commands=True)
"""No reading comes from the robot, and no command reaches it."""
late_plan_fault = partial(Fault, late=True)
"""The controller has no new command."""
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
