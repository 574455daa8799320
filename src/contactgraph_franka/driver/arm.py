"""An arm of seven joints: what its client tells in a tick, and what the maker says of it."""

from dataclasses import dataclass

import numpy as np

JOINTS = 7
TICK = 0.001
"""s, between the states of the arm and between its commands."""


@dataclass(slots=True)
class ArmState:
    """What is known of the arm in one tick, as any client of such an arm tells it.

    Positions and directions are in the frame of the base; gravity is the arm's own affair.
    """

    time: float
    """s, on the arm's own clock."""
    joints: np.ndarray
    """[7] rad."""
    joint_velocity: np.ndarray
    """[7] rad/s."""
    torque: np.ndarray
    """[7] N m, in force when this was read, without what holds the arm's weight."""
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
    """What motors and gears add to the links, and no client's model of the arm holds."""

    inertia: np.ndarray
    """[7] kg m^2, of rotors, as the joint feels it."""
    friction: np.ndarray
    """[7] N m, dry."""
    damping: np.ndarray
    """[7] N m s/rad."""


NO_DRIVES = JointDrives(np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS))
"""Of an arm whose torque control hides its motors altogether, as the maker says, and as the
rehearsal's does. The safe choice: friction that is not known is felt, and brakes."""
FR3_DRIVES = JointDrives(
    inertia=np.array([0.195] * 4 + [0.074] * 3),
    friction=np.array([1.137] * 4 + [0.763, 0.44, 0.248]),
    damping=np.full(JOINTS, 0.21),
)
"""Identified on one FR3 under torque control (MuJoCo Menagerie, franka_fr3, 2025-04-25). Only for
an arm that was seen to have them: friction that is not there pushes the hand on."""


@dataclass(frozen=True, eq=False)
class JointLimits:
    """What the maker allows each joint."""

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
"""Of the maker's data sheet and interface description."""


class ClockOffset:
    """Tells when, on the reader's clock, what the arm stamped on its own was so.

    A state that is seen for the first time came between the last look and this one, and that is
    all that is known for sure: the offset between the clocks changes only as far as it must to lie
    between. So stamps have no jitter of the reader's, and follow an arm whose clock is slower or
    stands still for a while. The way of the packet, some 0.2 ms, is not known and not in it.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._looked = 0.0

    def unchanged(self, now: float) -> None:
        """A look at ``now`` s found nothing new."""
        self._looked = now

    def changed(self, arm_time: float, now: float) -> float:
        """s on the reader's clock, of a new state that is found at ``now`` s."""
        if self._offset is None:
            self._offset = now - arm_time
        else:
            earliest, latest = self._looked - arm_time, now - arm_time
            self._offset = min(max(self._offset, earliest), latest)
        self._looked = now
        return arm_time + self._offset
