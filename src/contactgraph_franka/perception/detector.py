"""Depth as one more measurement: how far the planes of the tags are along the optical axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from contactgraph_franka.perception.calibration import CameraCalibration, TaggedObject
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, pose, rotation_of
from contactgraph_franka.perception.object_pose import ObjectPose, object_poses, refined_pose
from contactgraph_franka.perception.tags import TagDetection, TagDetector

DEPTH_NOISE = 0.003
"""m at 1 m, growing with the square of the distance: the error that all pixels of an object share.
Makers of stereo cameras promise a few times this; it does not shrink with the number of pixels."""
_INSIDE = 0.8
"""Of a tag's side: pixels further out may be of what is behind."""
_LEAST_PIXELS = 20
_GATE = 4.0
"""Standard deviations: what is farther off is of something in front of the tags."""


def with_depth(
    seen: ObjectPose,
    depth: np.ndarray,
    tagged: TaggedObject,
    intrinsics: Intrinsics,
    depth_noise: float = DEPTH_NOISE,
) -> ObjectPose:
    """The pose corrected by ``depth`` [H, W] m, where that shows the object's tags.

    The measurement is the median, over the pixels within the tags, of how much farther they are
    than ``seen`` says; pixels of 0 m are unknown. Without enough pixels, or where they contradict
    the tags altogether, ``seen`` comes back.
    """
    offsets, centre = _offsets(seen, depth, tagged, intrinsics)
    if len(offsets) < _LEAST_PIXELS:
        return seen
    offset = float(np.median(offsets))
    # By turns about the object's origin, and moves, of the tags' mean distance.
    slope = np.array([centre[1], -centre[0], 0.0, 0.0, 0.0, 1.0])
    noise = depth_noise * float(seen.pose[2, 3]) ** 2
    spread = seen.covariance @ slope
    variance = float(slope @ spread) + noise**2
    if offset**2 > _GATE**2 * variance:
        return seen
    gain = spread / variance
    step = gain * offset
    covariance = seen.covariance - np.outer(gain, spread)
    moved = pose(rotation_of(step[:3]) @ seen.pose[:3, :3], seen.pose[:3, 3] + step[3:])
    return replace(seen, pose=moved, covariance=0.5 * (covariance + covariance.T))


def _offsets(
    seen: ObjectPose, depth: np.ndarray, tagged: TaggedObject, intrinsics: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """Measured less explained distances [P] m, and the mean of the tags' centres [3] m.

    The centre is counted from the object's origin, along the camera's axes.
    """
    turn, place = seen.pose[:3, :3], seen.pose[:3, 3]
    found, centres = [], []
    for tag in (tagged.by_id[each] for each in seen.tags):
        middle = turn @ tag.pose[:3, 3]
        corners = (tag.corners @ turn.T - middle) * _INSIDE + middle + place
        pixels = _pixels_within(intrinsics.project(corners), depth.shape)
        measured = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        known = np.isfinite(measured) & (measured > 0.0)
        rays = intrinsics.rays(pixels[known].astype(np.float64))
        normal = turn @ tag.pose[:3, 2]
        distance = normal @ (middle + place) / (rays @ normal[:2] + normal[2])
        found.append(measured[known] - distance)
        centres.append(middle)
    return np.concatenate(found), np.mean(centres, axis=0)


def _pixels_within(corners: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """[P, 2]: columns and rows of the pixels inside the convex quadrangle ``corners`` [4, 2]."""
    height, width = shape
    low = np.clip(np.ceil(corners.min(axis=0)), 0, (width, height)).astype(int)
    high = np.clip(np.floor(corners.max(axis=0)) + 1, 0, (width, height)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    ways = np.roll(corners, -1, axis=0) - corners
    apart = pixels[:, None] - corners
    side = ways[:, 0] * apart[..., 1] - ways[:, 1] * apart[..., 0]
    return pixels[(side >= 0.0).all(axis=1) | (side <= 0.0).all(axis=1)]


_FLOOR = 2e-4
"""m: no position is believed to be surer, whatever the pixels say."""
_LARGEST_CORNER_ERROR, _LARGEST_ERROR = 30.0, 6.0
"""Standard deviations: a pose that explains its corners, and then the edges, worse is none."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """An object in one frame, in the frame of the robot's base."""

    pose: np.ndarray
    """[4, 4]: object to base."""
    covariance: np.ndarray
    """[3, 3] m^2, of the position."""
    tags: tuple[int, ...]
    """The ids that were seen."""
    time: float
    """s: the exposure."""

    @property
    def position(self) -> np.ndarray:
        """[3] m, of the object's origin."""
        return self.pose[:3, 3]


class ObjectDetector:
    """Finds the objects of a calibration in frames, one frame after another."""

    def __init__(self, calibration: CameraCalibration) -> None:
        self._calibration = calibration
        self._detector = TagDetector(tuple(each.by_id) for each in calibration.objects.values())

    def detect(self, frame: CameraFrame) -> Mapping[str, PoseEstimate]:
        """The objects in the frame, by their names; those that are not seen are left out.

        Raises `InvalidInputError` for a picture that is not grey.
        """
        detections = self._detector.detect(frame.image)
        seen = {}
        for name, tagged in self._calibration.objects.items():
            found = estimate_pose(frame, detections, tagged, self._calibration.intrinsics)
            if found is not None:
                seen[name] = _in_base(found, self._calibration.camera_pose, frame.time)
        return seen


def estimate_pose(
    frame: CameraFrame,
    detections: Sequence[TagDetection],
    tagged: TaggedObject,
    intrinsics: Intrinsics,
) -> ObjectPose | None:
    """An object's pose in the camera's frame by all that a frame tells; None where it is not seen.

    ``detections`` are the tags that a `TagDetector` found in the frame, of whatever object.
    """
    found, worth = None, 0.0
    for rough in object_poses(detections, tagged, intrinsics):
        if rough.error < _LARGEST_CORNER_ERROR:
            exact = refined_pose(frame.image, rough, tagged, intrinsics)
            if exact is not None and _worth(rough, exact) > worth:
                found, worth = exact, _worth(rough, exact)
    if found is None or found.error > _LARGEST_ERROR:
        return None
    if frame.depth is None:
        return found
    return with_depth(found, frame.depth, tagged, intrinsics)


def _worth(rough: ObjectPose, exact: ObjectPose) -> float:
    """Of two leanings, the true one explains the corners better, and more of the edges, and those
    better: any of it alone errs, where fingers hide half of a lone tag."""
    return exact.explained / (max(rough.error, 1.0) * max(exact.error, 1.0))


def _in_base(found: ObjectPose, camera: np.ndarray, time: float) -> PoseEstimate:
    turn = camera[:3, :3]
    covariance = turn @ found.covariance[3:, 3:] @ turn.T + _FLOOR**2 * np.eye(3)
    return PoseEstimate(camera @ found.pose, covariance, found.tags, time)
