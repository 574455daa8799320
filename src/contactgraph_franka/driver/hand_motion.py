"""Kinematics of the hand that need no more than its Jacobian and its orientation."""

import math

import numpy as np


def bias_acceleration(jacobian: np.ndarray, joint_velocity: np.ndarray) -> np.ndarray:
    r"""$\dot J \dot q$ ``[6]`` (m/s^2, rad/s^2): how the hand accelerates if no joint does.

    ``jacobian`` [6, 7] of a serial arm of revolute joints, ``joint_velocity`` [7] rad/s. Exact, and
    from the Jacobian alone: with $v_j$ and $w_j$ joint j's share in the hand's velocity and angular
    velocity, and $W_j = w_1 + \dots + w_j$,

    $$ \dot J \dot q = \Big( \sum_j (2 W_j - w_j) \times v_j,\; \sum_j W_j \times w_j \Big), $$

    since the axis of a joint turns with all joints before it, and its lever with all after it.
    """
    shares = jacobian * joint_velocity
    linear, angular = shares[:3], shares[3:]
    turned = np.cumsum(angular, axis=1)
    # A sum of cross products is the skew part of a product of matrices.
    F = (2.0 * turned - angular) @ linear.T
    G = turned @ angular.T
    return np.array(
        [
            F[1, 2] - F[2, 1],
            F[2, 0] - F[0, 2],
            F[0, 1] - F[1, 0],
            G[1, 2] - G[2, 1],
            G[2, 0] - G[0, 2],
            G[0, 1] - G[1, 0],
        ]
    )


def rotation_between(before: tuple[float, float, float, float], after: np.ndarray) -> np.ndarray:
    """[3] rad, in the frame of the base: the rotation from one orientation to another.

    Both are unit quaternions (x, y, z, w); ``before`` as plain numbers.
    """
    # Plain numbers: at a kilohertz, arrays of three take longer than what they are asked.
    a, b, c, d = before
    x, y, z, w = after.tolist()
    # after * conj(before)
    turn_w = w * d + x * a + y * b + z * c
    turn_x = -w * a + x * d - y * c + z * b
    turn_y = -w * b + x * c + y * d - z * a
    turn_z = -w * c - x * b + y * a + z * d
    sine = math.sqrt(turn_x * turn_x + turn_y * turn_y + turn_z * turn_z)
    if sine < 1e-9:
        return np.zeros(3)
    # The shorter way round: a quaternion and its negative are one orientation.
    angle = 2.0 * math.atan2(sine, abs(turn_w))
    scale = math.copysign(angle / sine, turn_w)
    return np.array([scale * turn_x, scale * turn_y, scale * turn_z])
