"""Whether a reading can be believed."""

import math

import numpy as np

from contactgraph_franka.robot.contract import RobotReading
from contactgraph_franka.robot.limits import SafetyLimits
from contactgraph_franka.robot.stop import StopReason

_ABSURD = 1e12
"""m, m/s or s: a number that no arm reads, and whose square a float still holds. Clocks that count
from 1970 are below it."""


def doubt(
    reading: RobotReading | None,
    last: RobotReading | None,
    now: float,
    hand: int,
    limits: SafetyLimits,
) -> StopReason | None:
    """Why ``reading``, at the time ``now`` s, is not believed; None where it is.

    ``last`` is the last reading that was believed, ``hand`` the index of the node that is driven.
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
    # A stamp from the future is as little use as an old one.
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
