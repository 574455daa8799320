"""First guesses of an object's pose from one of its tags, without iteration."""

import numpy as np

from contactgraph_franka.perception.rigid import inverse, nearest_rotation, pose, rotation_of
from contactgraph_franka.perception.tagged_object import CORNERS, Tag


def starts(tag: Tag, rays: np.ndarray) -> list[np.ndarray]:
    """Two poses [4, 4] of the object in the camera's frame, from its tag's corners.

    ``rays`` [4, 2] are x/z and y/z. A plane seen from afar looks the same when its normal is
    mirrored at the line of sight: the second pose is the first one mirrored so.
    """
    first = _from_square(rays, tag.size)
    sight = first[:3, 3] / np.linalg.norm(first[:3, 3])
    normal = first[:3, 2]
    mirrored = 2.0 * (normal @ sight) * sight - normal
    axis = np.cross(normal, mirrored)
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, normal @ mirrored))
    turn = rotation_of(axis * (angle / length)) if length > 1e-9 else np.eye(3)
    second = pose(turn @ first[:3, :3], first[:3, 3])
    to_tag = inverse(tag.pose)
    return [first @ to_tag, second @ to_tag]


def _from_square(rays: np.ndarray, size: float) -> np.ndarray:
    """The pose of a square from the homography of its plane: ``rays ~ [r1 r2 t] (x, y, 1)``."""
    x, y = (CORNERS * size).T[:2]
    u, v = rays.T
    one, none = np.ones(4), np.zeros(4)
    rows = np.concatenate(
        [
            np.stack([x, y, one, none, none, none, -u * x, -u * y, -u], axis=1),
            np.stack([none, none, none, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    # Columns of like size, for the smallest singular vector's sake.
    scale = np.array([size, size, 1.0] * 3)
    matrix = (np.linalg.svd(rows / scale)[2][-1] / scale).reshape(3, 3)
    matrix = (
        matrix
        * np.sign(matrix[2, 2])
        / np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    )
    one, two, place = matrix.T
    return pose(nearest_rotation(np.stack([one, two, np.cross(one, two)], axis=1)), place)
