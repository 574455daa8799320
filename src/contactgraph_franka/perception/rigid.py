"""Rigid motions as 4x4 matrices: ``pose_base_camera`` takes points of the camera to the base."""

import math

import numpy as np


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """[4, 4] from a rotation matrix [3, 3] and a position [3] m."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, position
    return made


def inverse(motion: np.ndarray) -> np.ndarray:
    """[4, 4], the way back."""
    back = motion[:3, :3].T
    return pose(back, -back @ motion[:3, 3])


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """[3, 3]: by ``|vector|`` rad about ``vector`` [3] (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    one = math.sin(angle) / angle
    two = (1.0 - math.cos(angle)) / angle**2
    return np.eye(3) + one * cross + two * cross @ cross


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """[3] rad, of length 0 to pi: what `rotation_of` turns into ``rotation`` [3, 3]."""
    # The largest part of the unit quaternion first: no half turn is near a division by zero.
    diagonal = np.diag(rotation)
    squares = np.array([1.0 + diagonal.sum(), *(1.0 + 2.0 * diagonal - diagonal.sum())])
    largest = int(np.argmax(squares))
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    quaternion = np.empty(4)
    quaternion[largest] = squares[largest]
    if largest == 0:
        quaternion[1:] = skew
    else:
        axis = largest - 1
        quaternion[1:] = rotation[axis] + rotation[:, axis]
        quaternion[largest] = squares[largest]
        quaternion[0] = skew[axis]
    quaternion /= np.linalg.norm(quaternion)
    if quaternion[0] < 0.0:
        quaternion = -quaternion
    length = float(np.linalg.norm(quaternion[1:]))
    if length < 1e-12:
        return 2.0 * quaternion[1:]
    return quaternion[1:] * (2.0 * math.atan2(length, quaternion[0]) / length)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3]: the rotation nearest to a matrix in the sense of least squares."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
