"""State, model parameters and limits of an arm of seven joints, and the offset of its clock."""

from dataclasses import dataclass

import numpy as np

JOINTS = 7
CYCLE = 0.001
"""s, between the states of the arm and between its commands."""


@dataclass(slots=True)
class ArmState:
    """State of the arm in one control cycle, as any client of such an arm reports it.

    Positions and directions are in the frame of the base; the arm itself compensates gravity.
    """

    time: float
    """s, on the arm's own clock."""
    joints: np.ndarray
    """[7] rad."""
    joint_velocity: np.ndarray
    """[7] rad/s."""
    torque: np.ndarray
    """[7] N m, in force when this was read, without gravity compensation."""
    mass: np.ndarray
    """[7, 7] kg m^2, inertia of the links."""
    coriolis: np.ndarray
    """[7] N m."""
    jacobian: np.ndarray
    """[6, 7] of the grasp point: m/s over rad/s, then rad/s over rad/s."""
    orientation: np.ndarray
    """[4] unit quaternion of the hand, (x, y, z, w)."""


@dataclass(frozen=True, eq=False)
class JointDrives:
    """Parameters of motors and gears, which no client's model of the arm includes."""

    inertia: np.ndarray
    """[7] kg m^2, of the rotors, at the joint."""
    friction: np.ndarray
    """[7] N m, dry."""
    damping: np.ndarray
    """[7] N m s/rad."""


NO_DRIVES = JointDrives(np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS))
"""For an arm whose torque control hides its motors altogether, as the maker states, and as the
simulated robot's does. The safe choice: unknown friction acts as a brake."""
FR3_DRIVES = JointDrives(
    inertia=np.array([0.195] * 4 + [0.074] * 3),
    friction=np.array([1.137] * 4 + [0.763, 0.44, 0.248]),
    damping=np.full(JOINTS, 0.21),
)
"""Identified on one FR3 under torque control (MuJoCo Menagerie, franka_fr3, 2025-04-25). Only for
an arm with measured friction like this: compensating absent friction accelerates the hand."""


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The maker's limits of each joint."""

    low: np.ndarray
    """[7] rad."""
    high: np.ndarray
    """[7] rad."""
    torque: np.ndarray
    """[7] N m."""
    torque_rate: float
    """N m/s."""


FR3_LIMITS = JointLimits(
    low=np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159]),
    high=np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159]),
    torque=np.array([87.0] * 4 + [12.0] * 3),
    torque_rate=1000.0,
)
"""From the maker's data sheet and interface description."""


class ClockOffset:
    """Converts the arm's time stamps to the reader's clock.

    A state that is new at a read arrived between the previous read and this one. The offset between
    the clocks changes only as far as these bounds require, so that time stamps are free of the
    reader's jitter, and follow an arm whose clock is slower or pauses. The packet's delay, some
    0.2 ms, is unknown and not included.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._last_read = 0.0

    def unchanged(self, now: float) -> None:
        """Records a read at ``now`` s without a new state."""
        self._last_read = now

    def changed(self, arm_time: float, now: float) -> float:
        """s on the reader's clock, of a state stamped ``arm_time`` s and new at ``now`` s."""
        if self._offset is None:
            self._offset = now - arm_time
        else:
            earliest, latest = self._last_read - arm_time, now - arm_time
            self._offset = min(max(self._offset, earliest), latest)
        self._last_read = now
        return arm_time + self._offset
