"""Slow motions to a place, by the arm's own position control."""

import math
from collections.abc import Callable

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.client import CLIENT_FAULTS, PLANNER_FAULT, franky

_ATTEMPTS = 3
"""To find a motion."""
_RESTING = 2e-4
"""rad/s: a joint that is slower rests."""
_SETTLED_WITHIN = 2.0
"""s"""


def check_transfer(position: np.ndarray, yaw: float, speed: float) -> None:
    """Raises `InvalidInputError` where these do not say where to, or how fast."""
    place = np.asarray(position, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite([*place, yaw]).all():
        raise InvalidInputError(f"position must be [3] m, and yaw rad, found {position}, {yaw}")
    if not 0.0 < speed <= 1.0:
        raise InvalidInputError(f"speed must be above 0 and at most 1, found {speed}")


def transfer(
    arm: "franky.Robot",
    position: np.ndarray,
    yaw: float,
    speed: float,
    point: "franky.Affine",
    clock: Callable[[], float],
) -> None:
    """Moves ``point``, as seen from the hand's own frame, to ``position`` [3] m, and waits for it.

    The hand points down, turned by ``yaw`` rad; ``speed`` is the share of the arm's own limits.
    Raises what the arm's client does.
    """
    down = np.array([math.cos(yaw / 2.0), math.sin(yaw / 2.0), 0.0, 0.0])
    target = franky.Affine(np.asarray(position, dtype=np.float64), down)
    for attempt in range(1, _ATTEMPTS + 1):
        motion = franky.CartesianMotion(target, relative_dynamics_factor=speed, ee_frame=point)
        try:
            arm.move(motion)
            break
        except CLIENT_FAULTS as error:
            if PLANNER_FAULT not in str(error) or attempt == _ATTEMPTS:
                raise
        _settle(arm, clock)
    _settle(arm, clock)


def _settle(arm: "franky.Robot", clock: Callable[[], float]) -> None:
    """Waits until ``arm`` rests, for at most 2 s: it follows what it is told with a lag."""
    until = clock() + _SETTLED_WITHIN
    while np.abs(arm.state.dq).max() > _RESTING and clock() < until:
        pass  # a state takes its tick to come
