"""Detection in a process of its own, on drawn tags."""

import os
import signal
import time
from functools import partial

import numpy as np
import pytest
from drawn_tags import CAMERA, LENS, SIZE, SlidingTag, calibration, drawn

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import CameraCalibration, CameraFrame, single_tag
from contactgraph_franka.perception.tracked_objects import TrackedObjects

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


def test_absent_objects_are_not_detected():
    assert ObjectDetector(calibration()).detect(CameraFrame(drawn([(4, 100, 80)]), None, 5.0)) == {}


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
    empty = CameraFrame(drawn([]), None, 0.01)
    at = [CameraFrame(drawn([(3, 100, 80)]), None, time) for time in (0.0, 0.02)]
    seeing = detected([at[0], None, empty, at[1]], calibration(), tmp_path)
    found = seeing.since("block")
    assert [each.time for each in found] == [0.0, 0.02]
    for each in found:
        np.testing.assert_allclose(each.position, expected(100), atol=3e-4)
        assert each.covariance.shape == (3, 3) and (np.diag(each.covariance) > 0.0).all()


def test_measurements_are_stored_by_object(tmp_path):
    objects = {"other": single_tag(5, SIZE), **calibration().objects}
    both = CameraCalibration(LENS, CAMERA, objects, calibration().made)
    seeing = detected([CameraFrame(drawn([(3, 100, 80)]), None, 0.0)], both, tmp_path)
    assert seeing.since("other") == [] and len(seeing.since("block")) == 1


def test_the_newest_five_measurements_are_returned(tmp_path):
    frames = [CameraFrame(drawn([(3, 100, 80)]), None, float(number)) for number in range(9)]
    seeing = detected(frames, calibration(), tmp_path)
    assert [each.time for each in seeing.since("block")] == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert [each.time for each in seeing.since("block", 6.5)] == [7.0, 8.0]
    assert seeing.since("block", 8.0) == []  # nothing newer


@pytest.mark.slow
def test_a_process_measures_position_and_velocity():
    with Perception(SlidingTag, calibration()) as seeing:
        objects, frames = TrackedObjects(seeing, ("block",)), 0
        until = time.monotonic() + 20.0
        while time.monotonic() < until:
            seeing.check()
            now = time.monotonic()
            (estimate,) = objects.estimates(now)
            frames = len(objects.tracks[1].states)
            if frames > 12 and estimate.tracked:
                break
            time.sleep(0.005)
    assert estimate.tracked and 0.0 <= now - estimate.time < 0.2
    # A pixel every 20 ms: to the camera's right, which is the base's y.
    speed = DISTANCE / LENS.fx / 0.02
    np.testing.assert_allclose(estimate.velocity, [0.0, speed, 0.0], atol=0.04)
    assert frames > 12


@pytest.mark.slow
def test_errors_in_the_process_are_raised():
    until = time.monotonic() + 20.0
    # On a busy machine the cable is out before the context is entered.
    with (
        pytest.raises(RuntimeError, match="the cable is out"),
        Perception(partial(SlidingTag, 3), calibration()) as seeing,
    ):
        while time.monotonic() < until:
            seeing.check()
            time.sleep(0.01)


@pytest.mark.slow
def test_the_death_of_the_process_is_raised():
    with Perception(SlidingTag, calibration()) as seeing:
        os.kill(seeing._worker.process.pid, signal.SIGKILL)
        seeing._worker.process.join()
        with pytest.raises(RuntimeError, match="the camera's process ended with exit code -9"):
            seeing.check()


def no_camera():
    raise InvalidInputError("no camera is attached")


@pytest.mark.slow
def test_mistakes_of_the_user_are_invalid_input():
    with pytest.raises(InvalidInputError, match=r"^no camera is attached$"):
        Perception(no_camera, calibration()).__enter__()
    first = calibration()
    with pytest.raises(InvalidInputError, match="names no objects"):
        Perception(SlidingTag, CameraCalibration(LENS, CAMERA, {}, first.made))
    larger = type(LENS)(300.0, 300.0, 319.5, 239.5, 640, 480)
    other = CameraCalibration(larger, CAMERA, first.objects, first.made)
    with pytest.raises(InvalidInputError, match="gives 320 x 240 px, but was calibrated at 640 x"):
        Perception(SlidingTag, other).__enter__()
