"""Motions of a gripper that handles a body, for scripted policies."""

import numpy as np

from contactgraph.envs.contract import Observation
from contactgraph.envs.gripper_task import GRIPPER, MAX_FORCE
from contactgraph.envs.pickup_layout import RADIUS

TOUCH_DISTANCE = 2.0 * RADIUS
"""Of the centres of two touching bodies, m."""
_STAND_OFF = 0.06
"""Gap behind a body from which it is approached, m."""

_GAIN = 4.0
"""1/s: the rate at which the velocity converges to the wanted one."""
_TOP_SPEED = 0.5
"""Of carrying, m/s."""
_PUSH_SPEED = 0.25
"""Of pushing a body that is not held, m/s: nothing but the gripper on its other side brakes it."""
_TOUCH_SPEED = 0.25
"""Of the gripper relative to a body at touch, m/s."""
_ROUND = 0.6
"""Missing speed of a body, m/s, for which the gripper goes round it to push from the right side."""
_PRESS = 0.5
"""Force that keeps a body touching, N."""
_BACK_OFF = 1.5
"""Force that parts the gripper from a body, N."""


def approach_velocity(
    offset: np.ndarray, direction: np.ndarray, speed: float, touch_speed: float
) -> np.ndarray:
    """The gripper's velocity relative to a body that it is to strike in ``direction``, [2] m/s.

    ``offset`` ``[2]`` m is the gripper's from the body, ``direction`` ``[2]`` has length 1. From
    behind the body the gripper strikes it at ``touch_speed`` m/s; from elsewhere it goes round the
    body at ``speed`` m/s.
    """
    behind = -float(offset @ direction)
    across = offset + behind * direction
    if behind > 0.8 * TOUCH_DISTANCE and np.linalg.norm(across) < 0.4 * TOUCH_DISTANCE:
        left = max(behind - TOUCH_DISTANCE - _STAND_OFF, 0.0)
        return min(touch_speed + 2.0 * left, speed) * direction - 4.0 * across
    goal = -(TOUCH_DISTANCE + _STAND_OFF) * direction
    if behind < TOUCH_DISTANCE:  # past its side first
        left_hand = np.array([-direction[1], direction[0]])
        side = left_hand if left_hand @ offset >= 0.0 else -left_hand
        goal = goal + 1.5 * TOUCH_DISTANCE * side
        if side @ offset < 1.2 * TOUCH_DISTANCE and behind > -2.0 * TOUCH_DISTANCE:
            goal = offset + TOUCH_DISTANCE * side
    return limited(4.0 * (goal - offset), speed)


def unit(vector: np.ndarray) -> np.ndarray:
    """``vector`` at length 1; the first axis for a vector of length 0."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0.0 else np.eye(len(vector))[0]


def limited(vector: np.ndarray, most: float) -> np.ndarray:
    """``vector``, shortened to the length ``most``."""
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)


class GripperForces:
    """Forces on a gripper that handles one body, in the state of an observation.

    The observation has the key ``holding``.
    """

    def __init__(self, observation: Observation, body: int) -> None:
        position, velocity = observation["position"], observation["velocity"]
        self.touches = bool(observation["contact"][GRIPPER, body])
        self.holds = bool(observation["holding"][GRIPPER, body])
        self.body_velocity = velocity[body]
        self.to_goal = observation["goal"] - position[body]
        """[2] m, from the body."""
        self.wanted = limited(2.0 * self.to_goal, _TOP_SPEED if self.holds else _PUSH_SPEED)
        """[2] m/s, of the body."""
        self.normal = unit(position[body] - position[GRIPPER])
        self._mass = 1 + int(observation["contact"][GRIPPER].sum())
        self._own = velocity[GRIPPER]
        self._from_body = position[GRIPPER] - position[body]

    @property
    def helps(self) -> bool:
        """Whether a push of the gripper brings the body's velocity nearer to the wanted one."""
        return float(self.normal @ (self.wanted - self.body_velocity)) > 0.0

    @property
    def placed(self) -> bool:
        """Whether the body rests near the goal."""
        rests = float(np.linalg.norm(self.body_velocity)) < 0.02
        return rests and float(np.linalg.norm(self.to_goal)) < 0.05

    def approach(
        self, least_missing: float = _ROUND, touch_speed: float = _TOUCH_SPEED
    ) -> np.ndarray:
        """[2] N to the body, and against it.

        Where the body misses more than ``least_missing`` m/s of the wanted velocity, the gripper
        goes to the side of the body from which a push helps.
        """
        missing = self.wanted - self.body_velocity
        direction = unit(missing) if np.linalg.norm(missing) > least_missing else self.normal
        velocity = approach_velocity(self._from_body, direction, 1.0, touch_speed)
        return 2.0 * self.move(self.body_velocity + velocity)

    def carry(self) -> np.ndarray:
        """[2] N that brings body and gripper to the goal."""
        return self.move(self.wanted)

    def press(self) -> np.ndarray:
        """[2] N along the normal, as far as that helps, and never less than keeps the touch."""
        across = self._own - self.body_velocity
        across = across - self.normal * (self.normal @ across)
        along = float(self.carry() @ self.normal)
        return max(along, _PRESS) * self.normal - _GAIN * across

    def accompany(self) -> np.ndarray:
        """[2] N that keeps the touch and hardly pushes."""
        return self.move(self.body_velocity + 0.02 * self.normal)

    def back_off(self) -> np.ndarray:
        """[2] N away from the body."""
        return -_BACK_OFF * self.normal

    def tear(self) -> np.ndarray:
        """[2] N away from the body that end its hold."""
        return -MAX_FORCE * self.normal

    def stop(self) -> np.ndarray:
        """[2] N that brings the gripper to rest."""
        return self.move(np.zeros(2))

    def move(self, velocity: np.ndarray) -> np.ndarray:
        """[2] N that bring the gripper to a velocity ``[2]`` m/s."""
        return limited(self._mass * _GAIN * (velocity - self._own), 3.0 * self._mass)
