"""Slow motions to a place, by the arm's own position control."""

import math
from collections.abc import Callable

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.robot.franka.client import franky

_RESTING = 2e-4
"""rad/s: a joint that is slower rests."""
_SETTLED_WITHIN = 2.0
"""s"""


def transfer(
    position: np.ndarray, yaw: float, speed: float, point: "franky.Affine"
) -> "franky.CartesianMotion":
    """A motion of ``point``, as seen from the hand's own frame, to ``position`` [3] m.

    The hand points down, turned by ``yaw`` rad. Raises `InvalidInputError` where the numbers are
    none, or ``speed``, the share of the arm's own limits, is not in (0, 1].
    """
    place = np.asarray(position, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite([*place, yaw]).all():
        raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
    if not 0.0 < speed <= 1.0:
        raise InvalidInputError(f"speed must be above 0 and at most 1, found {speed}")
    down = np.array([math.cos(yaw / 2.0), math.sin(yaw / 2.0), 0.0, 0.0])
    return franky.CartesianMotion(
        franky.Affine(place, down), relative_dynamics_factor=speed, ee_frame=point
    )


def settle(arm: "franky.Robot", clock: Callable[[], float]) -> None:
    """Waits until ``arm`` rests, for at most 2 s: it follows what it is told with a lag."""
    until = clock() + _SETTLED_WITHIN
    while np.abs(arm.state.dq).max() > _RESTING and clock() < until:
        pass  # a state takes its tick to come
