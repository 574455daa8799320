r"""The rigid motion that explains best where points were seen.

Of :math:`T` (object to camera), with points :math:`p_i` on the object, seen at :math:`y_i` across
the direction :math:`n_i` with a standard deviation :math:`\sigma_i`:

.. math:: \min_T \sum_i \rho\left(n_i \cdot (y_i - \pi(T p_i)) / \sigma_i\right)

by Gauss and Newton's method with Huber's :math:`\rho`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.calibration import CORNERS, Tag, TaggedObject
from contactgraph_franka.perception.camera import (
    Intrinsics,
    inverse,
    nearest_rotation,
    pose,
    rotation_of,
)
from contactgraph_franka.perception.edges import find_edges
from contactgraph_franka.perception.tags import TagDetection

_HUBER = 3.0
"""Standard deviations beyond which an error counts less than squared: an edge half hidden."""
_STEPS = 15
_SETTLED = 1e-6
"""rad and m: a step as short as this is the last."""
_LONGEST_TURN = 0.5
"""rad, of a step: a start that is far off must not be thrown farther."""
_LEAST_INFORMATION = 1e-3
"""Of turns [1/rad^2] and positions [1/m^2]: what nothing was seen of is known to 30 rad and m."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Points of an object in a picture, ``M`` of them; each one is known across one direction."""

    points: np.ndarray
    """[M, 3] m, in the object's frame."""
    rays: np.ndarray
    """[M, 2]: x/z and y/z in the camera's frame."""
    across: np.ndarray
    """[M, 2]: directions in the plane of ``rays``, over the standard deviation along them."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A rigid motion, and how well it explains what was seen."""

    pose: np.ndarray
    """[4, 4]: object to camera."""
    information: np.ndarray
    """[6, 6]: the covariance's inverse; a small turn about the object's origin [rad] first, then a
    small move [m], both along the camera's axes."""
    loss: float
    """The sum that was made small; infinite where the object would be behind the camera."""
    residual: np.ndarray
    """[M], in standard deviations."""


def fit_pose(start: np.ndarray, seen: Seen) -> PoseFit:
    """The motion [4, 4] that explains ``seen`` best, near ``start`` [4, 4]."""
    turn, place = start[:3, :3], start[:3, 3]
    for _ in range(_STEPS):
        residual, jacobian = _linearised(turn, place, seen)
        weight = _HUBER / np.maximum(np.abs(residual), _HUBER)
        step = np.linalg.solve(
            jacobian.T @ (weight[:, None] * jacobian) + _LEAST_INFORMATION * np.eye(6),
            jacobian.T @ (weight * residual),
        )
        step *= min(1.0, _LONGEST_TURN / max(float(np.linalg.norm(step[:3])), 1e-12))
        turn, place = rotation_of(step[:3]) @ turn, place + step[3:]
        if np.abs(step).max() < _SETTLED:
            break
    residual, jacobian = _linearised(turn, place, seen)
    length = np.abs(residual)
    weight = _HUBER / np.maximum(length, _HUBER)
    loss = np.where(length < _HUBER, length**2, _HUBER * (2.0 * length - _HUBER)).sum()
    in_front = np.isfinite(loss) and place[2] > 0.0
    return PoseFit(
        pose(nearest_rotation(turn), place) if in_front else start,
        jacobian.T @ (weight[:, None] * jacobian) + _LEAST_INFORMATION * np.eye(6),
        float(loss) if in_front else np.inf,
        residual,
    )


def _linearised(turn: np.ndarray, place: np.ndarray, seen: Seen) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [M] in standard deviations, and their slopes [M, 6] by turn and move."""
    turned = seen.points @ turn.T
    moved = turned + place
    depth = moved[:, 2:]
    rays = moved[:, :2] / depth
    across = seen.across
    by_move = np.concatenate([across, -(across * rays).sum(axis=1, keepdims=True)], axis=1) / depth
    # A turn w moves a point by w x (R p): its slope is (R p) x (slope by the move).
    by_turn = np.stack(
        [
            turned[:, 1] * by_move[:, 2] - turned[:, 2] * by_move[:, 1],
            turned[:, 2] * by_move[:, 0] - turned[:, 0] * by_move[:, 2],
            turned[:, 0] * by_move[:, 1] - turned[:, 1] * by_move[:, 0],
        ],
        axis=1,
    )
    residual = ((seen.rays - rays) * across).sum(axis=1)
    return residual, np.concatenate([by_turn, by_move], axis=1)


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


CORNER_NOISE = 0.15
"""px, standard deviation of a detected corner's coordinates."""
_LEAST_FACING = 0.2
"""Cosine of the angle between a tag's normal and the line of sight: seen flatter, edges blur."""
_SAME = 1e-3
"""Entries of two poses that differ by less are of one."""
_UNLIKELY = 500.0
"""Of the sum of squared errors in standard deviations: a pose that much worse is not the one. Edges
tell two poses apart much better than corners, some of which are a pixel off."""
_LEAST_EDGES = 4
"""Fewer do not tell a pose."""
_MEDIAN = 0.6745
"""Of the sizes of what is normally distributed with a standard deviation of 1."""


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Where an object is, in the camera's frame, and how sure that is."""

    pose: np.ndarray
    """[4, 4]: object to camera."""
    covariance: np.ndarray
    """[6, 6]: the true pose is turned by a small vector [rad] about the object's origin, and moved
    by another [m], both along the camera's axes; this is their covariance, the turn first."""
    tags: tuple[int, ...]
    """The ids that were seen."""
    error: float
    """How far what was seen lies from what the pose explains: the median, in standard deviations;
    half of the edges may be those of fingers. About 1 where all is well."""
    explained: int
    """How many points, corners or ends of edges, lie within three standard deviations."""


def object_poses(
    detections: Sequence[TagDetection],
    tagged: TaggedObject,
    intrinsics: Intrinsics,
    corner_noise: float = CORNER_NOISE,
) -> list[ObjectPose]:
    """The poses that the corners of those detections allow that are the object's own.

    None without any; else the likeliest first. A plane tag that leans to one side looks almost like
    one that leans to the other: where all corners of all tags leave that open, there is a second
    pose. ``corner_noise`` px is the standard deviation of a corner's coordinates.
    """
    tags = tagged.by_id
    own = [each for each in detections if each.id in tags]
    if not own:
        return []
    rays = intrinsics.rays(np.concatenate([each.corners for each in own]))
    points = np.concatenate([tags[each.id].corners for each in own])
    scale = np.diag([intrinsics.fx, intrinsics.fy]) / corner_noise
    seen = Seen(points.repeat(2, axis=0), rays.repeat(2, axis=0), np.tile(scale, (len(points), 1)))
    largest = int(np.argmax([_area(each.corners) for each in own]))
    corners = rays[4 * largest : 4 * largest + 4]
    fits = [fit_pose(start, seen) for start in starts(tags[own[largest].id], corners)]
    fits.sort(key=lambda fit: fit.loss)
    best, other = fits
    same = np.abs(best.pose - other.pose).max() < _SAME
    if same or other.loss > best.loss + _UNLIKELY:
        fits = [best]
    return [_pose(fit, tuple(each.id for each in own)) for fit in fits]


def refined_pose(
    image: np.ndarray, first: ObjectPose, tagged: TaggedObject, intrinsics: Intrinsics
) -> ObjectPose | None:
    """The pose from the tags' edges in ``image`` [H, W] uint8, looked for where ``first`` says.

    Several times as exact as corners from a detector. First with the tags that were detected, then
    with all that should be in sight: an edge is easier to find than a code to read. Edges that are
    hidden, or too narrow, count for nothing. None where fewer than four are found: the corners of
    one tag fit some pose even where no tag is.
    """
    best = first
    for tags in (first.tags, None, None):
        chosen = [tagged.by_id[each] for each in tags or _in_sight(best, tagged)]
        corners = np.stack([tag.corners for tag in chosen])
        ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        seen_from = corners @ best.pose[:3, :3].T + best.pose[:3, 3]
        edges = find_edges(image, intrinsics.project(seen_from))
        found = edges.found
        if found.sum() < _LEAST_EDGES:
            return None
        across = edges.normal * (intrinsics.fx, intrinsics.fy) / edges.noise[:, None]
        seen = Seen(
            ends[found].reshape(-1, 3),
            intrinsics.rays(edges.ends[found].reshape(-1, 2)),
            across[found].repeat(2, axis=0),
        )
        best = _pose(fit_pose(best.pose, seen), first.tags)
    return best


def _in_sight(seen: ObjectPose, tagged: TaggedObject) -> list[int]:
    """Ids of the tags that face the camera, those that were detected among them."""
    turn, place = seen.pose[:3, :3], seen.pose[:3, 3]
    facing = []
    for tag in tagged.tags:
        centre = turn @ tag.pose[:3, 3] + place
        if -(turn @ tag.pose[:3, 2]) @ centre > _LEAST_FACING * np.linalg.norm(centre):
            facing.append(tag.id)
    return sorted({*facing, *seen.tags})


def _pose(fit: PoseFit, tags: tuple[int, ...]) -> ObjectPose:
    error = float(np.median(np.abs(fit.residual)) / _MEDIAN)
    # What fits worse than the noise allows is trusted less: blur, a bent print, a hidden edge.
    covariance = np.linalg.inv(fit.information) * max(1.0, error**2)
    explained = int((np.abs(fit.residual) < 3.0).sum())
    return ObjectPose(fit.pose, covariance, tags, error, explained)


def _area(corners: np.ndarray) -> float:
    """px^2, of a quadrangle: half the cross product of its diagonals."""
    one, two = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(one[0] * two[1] - one[1] * two[0]))
