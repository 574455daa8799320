"""Calibration recovers the simulated camera and rejects insufficient poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import Intrinsics, Tag, TaggedObject
from contactgraph_franka.perception.camera import pose, rotation_of

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.hand_eye import calibrate
from contactgraph_franka.perception.object_pose import ObjectPose

LENS = Intrinsics(900.0, 900.0, 640.0, 360.0, 1280, 720)
CAMERA = pose(rotation_of(np.array([1.4, -1.5, 0.9])), np.array([1.25, 0.1, 0.5]))
MARKER_POSE = pose(rotation_of(np.array([0.3, 2.0, -0.5])), np.array([0.02, -0.01, 0.08]))
MARKER = TaggedObject(
    (Tag(0, 0.05, np.eye(4)), Tag(1, 0.05, pose(np.eye(3), np.array([0.08, 0.0, 0.0]))))
)


def simulated(count, rng, spread=0.35, axes=(1.0, 1.0, 1.0), noise=0.0):
    """Poses of the hand, and how the camera sees the marker, in front of it."""
    hands, views = [], []
    look = CAMERA @ pose(np.eye(3), np.array([0.0, 0.0, 0.9]))
    for _ in range(count):
        turn = rotation_of(rng.normal(0.0, spread, 3) * axes)
        hands.append(pose(turn, look[:3, 3] + rng.uniform(-0.15, 0.15, 3)))
        place = np.linalg.inv(CAMERA) @ hands[-1] @ MARKER_POSE
        shake = rotation_of(rng.normal(0.0, 2.0 * noise, 3))
        place = pose(shake @ place[:3, :3], place[:3, 3] + rng.normal(0.0, noise, 3))
        views.append(ObjectPose(place, np.eye(6), (0, 1), 1.0, 16))
    return np.array(hands), views


def test_calibration_without_noise_is_exact():
    found = calibrate(*simulated(8, np.random.default_rng(0)), MARKER, LENS)
    np.testing.assert_allclose(found.camera_pose, CAMERA, atol=1e-7)
    np.testing.assert_allclose(found.marker_pose, MARKER_POSE, atol=1e-7)
    assert found.residuals.pixel < 1e-4 and found.residuals.left_out_worst < 1e-6
    assert found.residuals.poses == 8


def test_residuals_measure_the_noise_that_is_averaged():
    found = calibrate(*simulated(20, np.random.default_rng(1), noise=5e-4), MARKER, LENS)
    off = np.linalg.inv(found.camera_pose) @ CAMERA
    assert np.linalg.norm(off[:3, 3]) < 2e-3
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 2e-3
    error = found.residuals
    assert 3e-4 < error.position < error.left_out < error.left_out_worst < 5e-3
    assert 0.1 < error.pixel < 3.0


def test_one_picture_that_was_misread_does_not_spoil_the_others():
    hands, views = simulated(12, np.random.default_rng(2), noise=1e-4)
    wrong = views[3].pose @ pose(rotation_of(np.array([0.0, 0.5, 0.0])), np.zeros(3))
    views[3] = ObjectPose(wrong, np.eye(6), (0, 1), 1.0, 16)
    found = calibrate(hands, views, MARKER, LENS)
    assert np.linalg.norm(found.camera_pose[:3, 3] - CAMERA[:3, 3]) < 3e-3
    assert found.residuals.left_out_worst > 1e-3


@pytest.mark.parametrize("axes", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], ids=["none", "one"])
def test_a_hand_that_turns_about_less_than_two_axes_is_refused(axes):
    hands, views = simulated(12, np.random.default_rng(3), axes=axes)
    with pytest.raises(InvalidInputError) as error:
        calibrate(hands, views, MARKER, LENS)
    assert "needs turns of the hand about two axes: about the second one" in str(error.value)
    assert "0.0 degrees" in str(error.value) and "\n" not in str(error.value)


def test_impossible_calibrations_are_refused():
    hands, views = simulated(8, np.random.default_rng(4))
    with pytest.raises(InvalidInputError, match=r"at least 6 poses of the hand, found 5$"):
        calibrate(hands[:5], views[:5], MARKER, LENS)
    with pytest.raises(InvalidInputError, match=r"as many as sightings \(7\), found \(8, 4, 4\)$"):
        calibrate(hands, views[:7], MARKER, LENS)
    with pytest.raises(InvalidInputError, match="hand pose 2 must be a rotation"):
        calibrate(hands * np.where(np.arange(8) == 2, 2.0, 1.0)[:, None, None], views, MARKER, LENS)
    others = TaggedObject((Tag(7, 0.05, np.eye(4)),))
    with pytest.raises(InvalidInputError, match="sighting 0 is of other tags than the marker's"):
        calibrate(hands, views, others, LENS)
