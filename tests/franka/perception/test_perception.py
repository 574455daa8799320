"""Detection in a process of its own, on drawn tags."""

import time

import numpy as np
import pytest
from drawn_tags import CAMERA, LENS, SIZE, calibration, drawn

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import CameraCalibration, CameraFrame, single_tag

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.detector import ObjectDetector
from contactgraph_franka.perception.perception import Perception, detect
from contactgraph_franka.shared_ring import RingReader

DISTANCE = LENS.fx * SIZE / 48.0
"""m: a tag of 48 px."""


def expected(column):
    """[3] m in the base: of a tag drawn at this column, 80 rows down."""
    centre = np.array([column + 29.5, 80 + 29.5])
    ray = np.append((centre - (LENS.cx, LENS.cy)) / LENS.fx, 1.0)
    return CAMERA[:3, :3] @ (DISTANCE * ray) + CAMERA[:3, 3]


def test_the_position_of_a_drawn_tag_is_exact():
    detected = ObjectDetector(calibration()).detect(CameraFrame(drawn([(3, 100, 80)]), None, 5.0))
    np.testing.assert_allclose(detected["block"].position, expected(100), atol=3e-4)
    assert detected["block"].tags == (3,) and detected["block"].time == 5.0
    # It faces the camera, upright.
    np.testing.assert_allclose(detected["block"].pose[:3, 2], [1.0, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(detected["block"].pose[:3, 1], [0.0, 0.0, 1.0], atol=0.02)
    spread = np.sqrt(np.diag(detected["block"].covariance))
    assert (spread < 2e-3).all() and spread[0] == spread.max()


class Frames:
    """A camera that shows the given frames, one a call; also the connection, until they end."""

    intrinsics = LENS
    closed = False

    def __init__(self, frames):
        self._frames = list(frames)
        self.sent = []

    def read(self):
        return self._frames.pop(0)

    def close(self):
        self.closed = True

    def poll(self):
        return not self._frames

    def send(self, message):
        self.sent.append(message)


def detected(frames, calibrated, folder):
    """The measurements of each object in the frames, by a `Perception` without its process."""
    camera = Frames(frames)
    paths = {name: folder / name for name in calibrated.objects}
    detect(camera, paths, lambda: camera, calibrated)
    assert camera.sent == [None] and camera.closed
    seeing = Perception(Frames, calibrated)
    seeing._rings = {name: RingReader(path) for name, path in paths.items()}
    return seeing


def test_each_frame_with_the_object_gives_one_measurement(tmp_path):
    objects = {"other": single_tag(5, SIZE), **calibration().objects}
    both = CameraCalibration(LENS, CAMERA, objects, calibration().made)
    foreign = CameraFrame(drawn([(4, 100, 80)]), None, 0.01)
    at = [CameraFrame(drawn([(3, 100, 80)]), None, time) for time in (0.0, 0.02)]
    seeing = detected([at[0], None, foreign, at[1]], both, tmp_path)
    found = seeing.since("block")
    assert seeing.since("other") == []
    assert [each.time for each in found] == [0.0, 0.02]
    for each in found:
        np.testing.assert_allclose(each.position, expected(100), atol=3e-4)
        assert each.covariance.shape == (3, 3) and (np.diag(each.covariance) > 0.0).all()


def test_the_newest_five_measurements_are_returned(tmp_path):
    frames = [CameraFrame(drawn([(3, 100, 80)]), None, float(number)) for number in range(9)]
    seeing = detected(frames, calibration(), tmp_path)
    assert [each.time for each in seeing.since("block")] == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert [each.time for each in seeing.since("block", 6.5)] == [7.0, 8.0]
    assert seeing.since("block", 8.0) == []  # nothing newer


class BrokenCamera:
    intrinsics = LENS

    def read(self):
        raise OSError("the cable is out")

    def close(self):
        pass


@pytest.mark.slow
def test_errors_in_the_process_are_raised():
    until = time.monotonic() + 20.0
    # On a busy machine the cable is out before the context is entered.
    with (
        pytest.raises(RuntimeError, match="the cable is out"),
        Perception(BrokenCamera, calibration()) as seeing,
    ):
        while time.monotonic() < until:
            seeing.check()
            time.sleep(0.01)


def no_camera():
    raise InvalidInputError("no camera is attached")


@pytest.mark.slow
def test_mistakes_of_the_user_are_invalid_input():
    with pytest.raises(InvalidInputError, match=r"^no camera is attached$"):
        Perception(no_camera, calibration()).__enter__()
    first = calibration()
    with pytest.raises(InvalidInputError, match="names no objects"):
        Perception(BrokenCamera, CameraCalibration(LENS, CAMERA, {}, first.made))
    larger = type(LENS)(300.0, 300.0, 319.5, 239.5, 640, 480)
    other = CameraCalibration(larger, CAMERA, first.objects, first.made)
    with pytest.raises(InvalidInputError, match="gives 320 x 240 px, but was calibrated at 640 x"):
        Perception(BrokenCamera, other).__enter__()
