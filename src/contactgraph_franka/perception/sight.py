"""From a camera's frame to where objects are in the frame of the robot's base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.calibration import CameraCalibration
from contactgraph_franka.perception.camera import CameraFrame, Intrinsics
from contactgraph_franka.perception.depth import with_depth
from contactgraph_franka.perception.object_pose import ObjectPose, object_poses, refined_pose
from contactgraph_franka.perception.tagged_object import TaggedObject
from contactgraph_franka.perception.tags import TagDetection, TagDetector

_FLOOR = 2e-4
"""m: no position is believed to be surer, whatever the pixels say."""
_LARGEST_CORNER_ERROR, _LARGEST_ERROR = 30.0, 6.0
"""Standard deviations: a pose that explains its corners, and then the edges, worse is none."""


@dataclass(frozen=True, eq=False)
class Sighting:
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


class Sight:
    """Finds the objects of a calibration in frames, one frame after another."""

    def __init__(self, calibration: CameraCalibration) -> None:
        self._calibration = calibration
        self._detector = TagDetector(tuple(each.by_id) for each in calibration.objects.values())

    def see(self, frame: CameraFrame) -> Mapping[str, Sighting]:
        """The objects in the frame, by their names; those that are not seen are left out.

        Raises `InvalidInputError` for a picture that is not grey.
        """
        detections = self._detector.detect(frame.image)
        seen = {}
        for name, tagged in self._calibration.objects.items():
            found = located(frame, detections, tagged, self._calibration.intrinsics)
            if found is not None:
                seen[name] = _in_base(found, self._calibration.camera_pose, frame.time)
        return seen


def located(
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


def _in_base(found: ObjectPose, camera: np.ndarray, time: float) -> Sighting:
    turn = camera[:3, :3]
    covariance = turn @ found.covariance[3:, 3:] @ turn.T + _FLOOR**2 * np.eye(3)
    return Sighting(camera @ found.pose, covariance, found.tags, time)
