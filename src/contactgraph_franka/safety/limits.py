"""Safety limits as data, and the forces that keep to them: virtual walls and a rate limit."""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError

_DAMPING = 100.0
"""N s/m: damping of the virtual walls and of the speed limit."""
_STIFFNESS = 400.0
"""N/m, of the virtual walls. With `_DAMPING` overdamped for hands of up to 6 kg, so that a wall is
approached without overshoot."""
_WALL = 0.01
"""m: distance of the virtual walls from the faces of the workspace, inwards."""
_SPEED_SHARE = 0.9
"""Share of the largest speed at which no force along the motion is left."""


@dataclass(frozen=True)
class SafetyLimits:
    """The limits enforced by `SafetyFilter`. The defaults suit an arm like the Franka Panda.

    They must allow the stop they promise: the wait for a late command or reading, and then easing
    the largest force off at the largest rate, have to fit into ``stop_within``. Raises
    `InvalidInputError` where they do not, or where a limit is not a positive number.
    """

    max_force: float = 20.0
    """N, the length of the force on the hand. Far below what the arm can do: 87 N m in the joints
    that carry it, at a distance of 0.855 m, is 100 N (the maker's data sheet)."""
    max_force_rate: float = 1200.0
    """N/s. The maker allows torques to change by 1000 N m/s in each joint; at the workspace's
    farthest corner, 0.81 m from the base's axis, this is 970 N m/s."""
    max_speed: float = 1.0
    """m/s, of the hand. The maker's limit is 1.7 m/s."""
    workspace_low: tuple[float, ...] = (0.28, -0.37, 0.02)
    """[D] m, the lowest corner of the hand's workspace, in the frame of the base."""
    workspace_high: tuple[float, ...] = (0.72, 0.37, 0.40)
    """[D] m, the opposite corner. The Panda can point down everywhere in the box."""
    longest_age: float = 0.003
    """s: the greatest age of a hand's reading. Three cycles of the arm's 1 kHz."""
    longest_track_age: float = 0.003
    """s: the greatest age of the other nodes' readings. A camera needs more, such as 0.1; the time
    to stop then counts from when the object counts as lost."""
    longest_gap: float = 0.003
    """s: between commands, and between the cycles of the loop."""
    largest_jump: float = 0.02
    """m: how much farther than at ``max_speed`` a tracked position may move between readings."""
    stop_within: float = 0.020
    """s, from a lasting fault to no force but the robot's own brake."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not name.startswith("workspace") and not (math.isfinite(value) and value > 0.0):
                raise InvalidInputError(f"{name} must be a positive number, found {value}")
        low, high = self.workspace_low, self.workspace_high
        corners = zip(low, high, strict=False)
        # A comparison with NaN is False, so this refuses it too.
        if not low or len(low) != len(high) or not all(a < b for a, b in corners):
            raise InvalidInputError(
                f"workspace_low must be below workspace_high on each axis, found {low} and {high}"
            )
        wait = max(self.longest_gap, self.longest_age)
        needed = wait + self.max_force / self.max_force_rate
        if needed > self.stop_within:
            raise InvalidInputError(
                f"stop_within is {self.stop_within} s, but longest_gap or longest_age, and easing "
                f"max_force off at max_force_rate, take {needed:.4f} s: lower these or the force"
            )


def clip_norm(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, scaled down to ``length`` where it is longer."""
    # Not `numpy.linalg.norm`, whose squares overflow.
    norm = math.hypot(*vector)
    return vector if norm <= length else vector * (length / norm)


def apply_virtual_walls(
    force: np.ndarray, position: np.ndarray, velocity: np.ndarray, limits: SafetyLimits
) -> np.ndarray:
    r"""The nearest force that leads neither out of the workspace nor past the largest speed.

    Along each axis the force towards a wall at $x_w$ is at most
    $k (x_w - x) - c\,\dot x$, and along the motion at most $c\,(0.9\,v_{max} - v)$:
    free motion far from limits, and a smooth end before them.

    ``force`` [D] N, ``position`` [D] m and ``velocity`` [D] m/s of the hand. The length of the
    result, [D] N, is at most ``max_force``.
    """
    force = clip_norm(force, limits.max_force)
    speed = math.hypot(*velocity)
    if speed > 0.0:
        along = velocity / speed
        excess = force @ along - _DAMPING * (_SPEED_SHARE * limits.max_speed - speed)
        if excess > 0.0:
            force = force - excess * along
    low = np.asarray(limits.workspace_low) + _WALL - position
    high = np.asarray(limits.workspace_high) - _WALL - position
    drag = _DAMPING * velocity
    force = np.minimum(np.maximum(force, _STIFFNESS * low - drag), _STIFFNESS * high - drag)
    return clip_norm(force, limits.max_force)


def limit_rate(
    last: np.ndarray, target: np.ndarray, duration: float, limits: SafetyLimits
) -> np.ndarray:
    """The force [D] N nearest to ``target`` that may follow ``last`` after ``duration`` s."""
    return last + clip_norm(target - last, limits.max_force_rate * duration)
