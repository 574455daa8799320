"""Detection of a calibration's objects in camera frames, in the frame of the robot's base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph_franka.perception.calibration import CameraCalibration, TaggedObject
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, perturbed
from contactgraph_franka.perception.object_pose import ObjectPose, object_poses, refined_pose
from contactgraph_franka.perception.tags import TagDetection, TagDetector

DEPTH_NOISE = 0.003
"""Standard deviation of the error that all pixels of an object share, m at 1 m; it grows with the
square of the distance. Makers of stereo cameras state a few times this."""
_LEAST_NOISE = 2e-4  # m, of a position
_LARGEST_CORNER_ERROR, _LARGEST_ERROR = 30.0, 6.0
"""Standard deviations of corners, and then of edges, beyond which a pose is rejected."""
_INSIDE = 0.8
"""Share of a tag's side whose depth is used; pixels further out may show the background."""
_LEAST_PIXELS = 20
_GATE = 4.0  # Standard deviations beyond which depth is that of an occluder


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """An object in one frame, in the frame of the robot's base."""

    pose: np.ndarray
    """[4, 4]: object to base."""
    covariance: np.ndarray
    """[3, 3] m^2, of the position."""
    tags: tuple[int, ...]
    """The detected ids."""
    time: float
    """s: the exposure."""

    @property
    def position(self) -> np.ndarray:
        """[3] m, of the object's origin."""
        return self.pose[:3, 3]


class ObjectDetector:
    """Detects the objects of a calibration in successive frames."""

    def __init__(self, calibration: CameraCalibration) -> None:
        self._calibration = calibration
        self._detector = TagDetector(tuple(each.by_id) for each in calibration.objects.values())

    def detect(self, frame: CameraFrame) -> Mapping[str, PoseEstimate]:
        """The detected objects by their names; raises `InvalidInputError` unless grey."""
        detections = self._detector.detect(frame.image)
        camera, estimates = self._calibration.camera_pose, {}
        for name, tagged in self._calibration.objects.items():
            found = estimate_pose(frame, detections, tagged, self._calibration.intrinsics)
            if found is not None:
                turn = camera[:3, :3]
                covariance = turn @ found.covariance[3:, 3:] @ turn.T
                covariance += _LEAST_NOISE**2 * np.eye(3)
                estimates[name] = PoseEstimate(
                    camera @ found.pose, covariance, found.tags, frame.time
                )
        return estimates


def estimate_pose(
    frame: CameraFrame,
    detections: Sequence[TagDetection],
    tagged: TaggedObject,
    intrinsics: Intrinsics,
) -> ObjectPose | None:
    """An object's pose in the camera's frame from corners, edges and depth; None if not detected.

    ``detections`` are all tags that a `TagDetector` found in the frame.
    """
    best, best_score = None, 0.0
    for rough in object_poses(detections, tagged, intrinsics):
        if rough.error < _LARGEST_CORNER_ERROR:
            refined = refined_pose(frame.image, rough, tagged, intrinsics)
            if refined is not None and _score(rough, refined) > best_score:
                best, best_score = refined, _score(rough, refined)
    if best is None or best.error > _LARGEST_ERROR:
        return None
    if frame.depth is None:
        return best
    return with_depth(best, frame.depth, tagged, intrinsics)


def with_depth(
    estimate: ObjectPose,
    depth: np.ndarray,
    tagged: TaggedObject,
    intrinsics: Intrinsics,
    depth_noise: float = DEPTH_NOISE,
) -> ObjectPose:
    """The pose corrected by ``depth`` [H, W] m of the object's tags; 0 m is unknown.

    The measurement is the median over the tags' pixels of measured less predicted depth, a Kalman
    update. ``estimate`` is returned for too few pixels or depth that contradicts it.
    """
    offsets, centre = _depth_offsets(estimate, depth, tagged, intrinsics)
    if len(offsets) < _LEAST_PIXELS:
        return estimate
    offset = float(np.median(offsets))
    # Slope of the tags' mean depth by turns about the object's origin, and by moves.
    slope = np.array([centre[1], -centre[0], 0.0, 0.0, 0.0, 1.0])
    noise = depth_noise * float(estimate.pose[2, 3]) ** 2
    spread = estimate.covariance @ slope
    variance = float(slope @ spread) + noise**2
    if offset**2 > _GATE**2 * variance:
        return estimate
    gain = spread / variance
    covariance = estimate.covariance - np.outer(gain, spread)
    return replace(
        estimate,
        pose=perturbed(estimate.pose, gain * offset),
        covariance=0.5 * (covariance + covariance.T),
    )


def _score(rough: ObjectPose, refined: ObjectPose) -> float:
    """Combines corner error, edge error and inlier count of one of two tilts.

    Any of them alone errs when fingers hide half of a single tag.
    """
    return refined.explained / (max(rough.error, 1.0) * max(refined.error, 1.0))


def _depth_offsets(
    estimate: ObjectPose, depth: np.ndarray, tagged: TaggedObject, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """Measured less predicted depth [P] m, and the mean of the tags' centres [3] m.

    The centre is relative to the object's origin, along the camera's axes.
    """
    turn, position = estimate.pose[:3, :3], estimate.pose[:3, 3]
    offsets, centres = [], []
    for tag in (tagged.by_id[each] for each in estimate.tags):
        middle = turn @ tag.pose[:3, 3]
        corners = (tag.corners @ turn.T - middle) * _INSIDE + middle + position
        pixels = _pixels_within(intrinsics.project(corners), depth.shape)
        measured = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        known = np.isfinite(measured) & (measured > 0.0)
        rays = intrinsics.rays(pixels[known].astype(np.float64))
        normal = turn @ tag.pose[:3, 2]
        distance = normal @ (middle + position) / (rays @ normal[:2] + normal[2])
        offsets.append(measured[known] - distance)
        centres.append(middle)
    return np.concatenate(offsets), np.mean(centres, axis=0)


def _pixels_within(corners: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """[P, 2]: columns and rows of the pixels inside the convex quadrangle ``corners`` [4, 2]."""
    height, width = shape
    low = np.clip(np.ceil(corners.min(axis=0)), 0, (width, height)).astype(int)
    high = np.clip(np.floor(corners.max(axis=0)) + 1, 0, (width, height)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    sides = np.roll(corners, -1, axis=0) - corners
    apart = pixels[:, None] - corners
    cross = sides[:, 0] * apart[..., 1] - sides[:, 1] * apart[..., 0]
    return pixels[(cross >= 0.0).all(axis=1) | (cross <= 0.0).all(axis=1)]
