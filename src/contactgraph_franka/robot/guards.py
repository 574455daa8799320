"""Forces that are turned before a limit is reached, and changed no faster than allowed."""

import math

import numpy as np

from contactgraph_franka.robot.limits import SafetyLimits

_DAMPING = 100.0
"""N s/m: how firmly guards resist motion towards a limit."""
_STIFFNESS = 400.0
"""N/m, of the guarding walls. With `_DAMPING` overdamped for hands of up to 6 kg, so that a wall is
approached and not run over."""
_WALL = 0.01
"""m: how far inside the workspace the guarding walls stand."""
_SPEED_SHARE = 0.9
"""Of the largest speed, where a guard leaves no force along the motion."""


def shortened(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, or the one in its direction with this length if it is longer."""
    # Not `numpy.linalg.norm`, whose squares overflow.
    found = math.hypot(*vector)
    return vector if found <= length else vector * (length / found)


def guarded(
    force: np.ndarray, position: np.ndarray, velocity: np.ndarray, limits: SafetyLimits
) -> np.ndarray:
    r"""The nearest force that leads neither out of the workspace nor past the largest speed.

    Along each axis the force that pushes on towards a wall at :math:`x_w` is at most
    :math:`k (x_w - x) - c\,\dot x`, and along the motion at most :math:`c\,(0.9\,v_{max} - v)`:
    free motion far from limits, and a smooth end before them.

    ``force`` [D] N, ``position`` [D] m and ``velocity`` [D] m/s of the hand. The length of what is
    returned, [D] N, is at most ``max_force``.
    """
    force = shortened(force, limits.max_force)
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
    return shortened(force, limits.max_force)


def approached(
    last: np.ndarray, target: np.ndarray, duration: float, limits: SafetyLimits
) -> np.ndarray:
    """The force [D] N nearest to ``target`` that may follow ``last`` after ``duration`` s."""
    return last + shortened(target - last, limits.max_force_rate * duration)
