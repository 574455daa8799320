"""The pose of an object from all of its tags at once: from corners, then from edges and depth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.camera import Intrinsics
from contactgraph_franka.perception.edges import find_edges
from contactgraph_franka.perception.planar_start import starts
from contactgraph_franka.perception.pose_fit import PoseFit, Seen, fit_pose
from contactgraph_franka.perception.tagged_object import TaggedObject
from contactgraph_franka.perception.tags import TagDetection

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
