r"""The pose of an object from all of its tags: from corners, then refined by edges.

The rigid motion $T$ (object to camera) minimises, over points $p_i$ on the object
observed at $y_i$ along the direction $n_i$ with standard deviation $\sigma_i$,

$$ \min_T \sum_i \rho\left(n_i \cdot (y_i - \pi(T p_i)) / \sigma_i\right) $$

by Gauss-Newton with Huber's $\rho$.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.calibration import CORNERS, Tag, TaggedObject
from contactgraph_franka.perception.camera import (
    Intrinsics,
    nearest_rotation,
    pose,
    rotation_of,
    transform,
)
from contactgraph_franka.perception.edges import find_edges
from contactgraph_franka.perception.tags import TagDetection

CORNER_NOISE = 0.15
"""px, standard deviation of a detected corner's coordinates."""
_HUBER = 3.0  # Standard deviations from which an error counts linearly, as of a half hidden edge
_ITERATIONS = 15
_STEP_TOLERANCE = 1e-6  # rad and m
_LARGEST_TURN = 0.5  # rad, of one step; limits divergence from a poor start
_PRIOR = 1e-3 * np.eye(6)
"""Prior information on turns [1/rad^2] and positions [1/m^2]: 30 rad and 30 m."""
_LEAST_FACING = 0.2  # Cosine between a tag's normal and the line of sight, below which edges blur
_SAME = 1e-3  # Largest difference between the entries of two poses that count as one
_UNLIKELY = 500.0
"""Difference in loss that rules out the second pose. It is large, since edges distinguish two poses
far better than corners, some of which are a pixel off."""
_LEAST_EDGES = 4
_MEDIAN = 0.6745  # Median of the absolute value of a standard normal variable


@dataclass(frozen=True, eq=False)
class Observations:
    """``M`` points of an object in a picture, each observed along one direction."""

    points: np.ndarray
    """[M, 3] m, in the object's frame."""
    rays: np.ndarray
    """[M, 2]: x/z and y/z in the camera's frame."""
    directions: np.ndarray
    """[M, 2]: unit directions in the plane of ``rays`` over the standard deviation along them."""


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Pose of an object in the camera's frame."""

    pose: np.ndarray
    """[4, 4]: object to camera."""
    covariance: np.ndarray
    """[6, 6]: of a small turn [rad] about the object's origin and a small move [m], both along the
    camera's axes."""
    tags: tuple[int, ...]
    """The detected ids."""
    error: float
    """Median absolute residual over that of the noise model: about 1 for a good fit. The median
    tolerates edges of fingers."""
    explained: int
    """Number of corners and edge ends within three standard deviations."""
    loss: float = 0.0
    """The minimised sum; infinite if the object is behind the camera."""


def object_poses(
    detections: Sequence[TagDetection],
    tagged: TaggedObject,
    intrinsics: Intrinsics,
    corner_noise: float = CORNER_NOISE,
) -> list[ObjectPose]:
    """The poses that explain the corners of the object's detected tags, the likeliest first.

    Empty without such tags. A planar tag has two tilts that look almost alike; the result has two
    poses if the corners do not rule one out. ``corner_noise`` px is the standard deviation of a
    corner's coordinates.
    """
    tags = tagged.by_id
    own = [each for each in detections if each.id in tags]
    if not own:
        return []
    rays = intrinsics.rays(np.concatenate([each.corners for each in own]))
    points = np.concatenate([tags[each.id].corners for each in own])
    scale = np.diag([intrinsics.fx, intrinsics.fy]) / corner_noise
    observed = Observations(
        points.repeat(2, axis=0), rays.repeat(2, axis=0), np.tile(scale, (len(points), 1))
    )
    largest = int(np.argmax([_area(each.corners) for each in own]))
    corners = rays[4 * largest : 4 * largest + 4]
    starts = initial_poses(tags[own[largest].id], corners)
    ids = tuple(each.id for each in own)
    best, other = sorted((fit_pose(start, observed, ids) for start in starts), key=lambda f: f.loss)
    same = np.abs(best.pose - other.pose).max() < _SAME
    return [best] if same or other.loss > best.loss + _UNLIKELY else [best, other]


def refined_pose(
    image: np.ndarray, first: ObjectPose, tagged: TaggedObject, intrinsics: Intrinsics
) -> ObjectPose | None:
    """The pose from the tags' edges in ``image`` [H, W] uint8, searched where ``first`` predicts.

    Several times as exact as the corners. The first iteration uses the detected tags, the others
    all tags that face the camera. Hidden and narrow edges are ignored. None if fewer than four
    edges are found: the corners alone also fit false detections.
    """
    best = first
    for tags in (first.tags, None, None):
        chosen = [tagged.by_id[each] for each in tags or _facing(best, tagged)]
        corners = np.stack([tag.corners for tag in chosen])
        ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        edges = find_edges(image, intrinsics.project(transform(best.pose, corners)))
        found = edges.found
        if found.sum() < _LEAST_EDGES:
            return None
        directions = edges.normal * (intrinsics.fx, intrinsics.fy) / edges.noise[:, None]
        observed = Observations(
            ends[found].reshape(-1, 3),
            intrinsics.rays(edges.ends[found].reshape(-1, 2)),
            directions[found].repeat(2, axis=0),
        )
        best = fit_pose(best.pose, observed, first.tags)
    return best


def fit_pose(start: np.ndarray, observed: Observations, tags: tuple[int, ...]) -> ObjectPose:
    """The pose near ``start`` [4, 4] that explains the observations of ``tags`` best."""
    turn, position = start[:3, :3], start[:3, 3]
    for _ in range(_ITERATIONS):
        residual, jacobian = _linearised(turn, position, observed)
        weight = _HUBER / np.maximum(np.abs(residual), _HUBER)
        step = np.linalg.solve(
            jacobian.T @ (weight[:, None] * jacobian) + _PRIOR,
            jacobian.T @ (weight * residual),
        )
        step *= min(1.0, _LARGEST_TURN / max(float(np.linalg.norm(step[:3])), 1e-12))
        turn, position = rotation_of(step[:3]) @ turn, position + step[3:]
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    residual, jacobian = _linearised(turn, position, observed)
    length = np.abs(residual)
    weight = _HUBER / np.maximum(length, _HUBER)
    loss = np.where(length < _HUBER, length**2, _HUBER * (2.0 * length - _HUBER)).sum()
    in_front = np.isfinite(loss) and position[2] > 0.0
    error = float(np.median(length) / _MEDIAN)
    information = jacobian.T @ (weight[:, None] * jacobian) + _PRIOR
    return ObjectPose(
        pose(nearest_rotation(turn), position) if in_front else start,
        # A fit worse than the noise model (blur, bent prints, hidden edges) is less certain.
        np.linalg.inv(information) * max(1.0, error**2),
        tags,
        error,
        int((length < 3.0).sum()),
        float(loss) if in_front else np.inf,
    )


def initial_poses(tag: Tag, rays: np.ndarray) -> list[np.ndarray]:
    """Two poses [4, 4] of the object in the camera's frame from the corners of one tag.

    ``rays`` [4, 2] are x/z and y/z. A distant plane looks the same with its normal mirrored at the
    line of sight; the second pose is that mirror image of the first.
    """
    first = _pose_from_homography(rays, tag.size)
    sight = first[:3, 3] / np.linalg.norm(first[:3, 3])
    normal = first[:3, 2]
    mirrored = 2.0 * (normal @ sight) * sight - normal
    axis = np.cross(normal, mirrored)
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, normal @ mirrored))
    turn = rotation_of(axis * (angle / length)) if length > 1e-9 else np.eye(3)
    second = pose(turn @ first[:3, :3], first[:3, 3])
    to_tag = np.linalg.inv(tag.pose)
    return [first @ to_tag, second @ to_tag]


def _pose_from_homography(rays: np.ndarray, size: float) -> np.ndarray:
    """[4, 4] of a square from the homography of its plane: ``rays ~ [r1 r2 t] (x, y, 1)``."""
    x, y = (CORNERS * size).T[:2]
    u, v = rays.T
    one, zero = np.ones(4), np.zeros(4)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    # Scaled columns condition the smallest singular vector.
    scale = np.array([size, size, 1.0] * 3)
    matrix = (np.linalg.svd(rows / scale)[2][-1] / scale).reshape(3, 3)
    norm = np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    one, two, position = (matrix * np.sign(matrix[2, 2]) / norm).T
    return pose(nearest_rotation(np.stack([one, two, np.cross(one, two)], axis=1)), position)


def _linearised(
    turn: np.ndarray, position: np.ndarray, observed: Observations
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [M] in standard deviations, and their slopes [M, 6] by turn and move."""
    turned = observed.points @ turn.T
    moved = turned + position
    depth = moved[:, 2:]
    rays = moved[:, :2] / depth
    across = observed.directions
    by_move = np.concatenate([across, -(across * rays).sum(axis=1, keepdims=True)], axis=1) / depth
    # A turn w moves a point by w x (R p), so that its slope is (R p) x (slope by the move).
    # Written out, which is several times as fast as `np.cross`.
    (x, y, z), (u, v, w) = turned.T, by_move.T
    by_turn = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
    residual = ((observed.rays - rays) * across).sum(axis=1)
    return residual, np.concatenate([by_turn, by_move], axis=1)


def _facing(estimate: ObjectPose, tagged: TaggedObject) -> list[int]:
    """Ids of the tags that face the camera, including the detected ones."""
    facing = set(estimate.tags)
    for tag in tagged.tags:
        centre = transform(estimate.pose, tag.pose[:3, 3])
        normal = estimate.pose[:3, :3] @ tag.pose[:3, 2]
        if -normal @ centre > _LEAST_FACING * np.linalg.norm(centre):
            facing.add(tag.id)
    return sorted(facing)


def _area(corners: np.ndarray) -> float:
    """px^2, of a quadrangle: half the cross product of its diagonals."""
    one, two = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(one[0] * two[1] - one[1] * two[0]))
