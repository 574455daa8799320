"""Detection in a process of its own, on drawn tags."""

import multiprocessing
import os
import signal
import time
from functools import partial

import numpy as np
import pytest
from drawn_tags import CAMERA, LENS, SIZE, SlidingTag, calibration, drawn

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import CameraCalibration, CameraFrame, single_tag
from contactgraph_franka.perception.perception import (
    PositionMeasurement,
    SharedMeasurements,
)
from contactgraph_franka.perception.tracked_objects import TrackedObjects

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.detector import ObjectDetector
from contactgraph_franka.perception.perception import DetectionLoop, Perception

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
    """A camera that shows the given frames, one a call."""

    intrinsics = LENS

    def __init__(self, frames):
        self._frames = iter(frames)

    def read(self):
        return next(self._frames, None)


def test_each_frame_with_the_object_gives_one_measurement():
    empty = CameraFrame(drawn([]), None, 0.01)
    at = [CameraFrame(drawn([(3, 100, 80)]), None, time) for time in (0.0, 0.02)]
    shared = SharedMeasurements(1, multiprocessing.get_context("spawn"))
    loop = DetectionLoop(Frames([at[0], empty, at[1]]), calibration(), shared)
    assert [loop.step() for _ in range(4)] == [True] * 3 + [False]
    detected = shared.since(0)
    assert [each.time for each in detected] == [0.0, 0.02]
    for each in detected:
        np.testing.assert_allclose(each.position, expected(100), atol=3e-4)


def test_measurements_are_stored_by_object():
    objects = {"other": single_tag(5, SIZE), **calibration().objects}
    both = CameraCalibration(LENS, CAMERA, objects, calibration().made)
    shared = SharedMeasurements(2, multiprocessing.get_context("spawn"))
    frame = CameraFrame(drawn([(3, 100, 80)]), None, 0.0)
    assert DetectionLoop(Frames([frame]), both, shared).step()
    assert shared.since(0) == [] and len(shared.since(1)) == 1


@pytest.mark.slow
def test_a_process_measures_position_and_velocity():
    with Perception(SlidingTag, calibration()) as seeing:
        detected, frames = TrackedObjects(seeing, ("block",)), 0
        until = time.monotonic() + 20.0
        while time.monotonic() < until:
            seeing.check()
            now = time.monotonic()
            (estimate,) = detected.estimates(now)
            frames = len(detected.tracks[1].states)
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
    seeing = Perception(partial(SlidingTag, 3), calibration())
    until = time.monotonic() + 20.0
    with pytest.raises(RuntimeError, match="the cable is out"):
        seeing.start()  # on a busy machine the cable is out before this returns
        while time.monotonic() < until:
            seeing.check()
            time.sleep(0.01)
    seeing.close()


@pytest.mark.slow
def test_the_death_of_the_process_is_raised():
    with Perception(SlidingTag, calibration()) as seeing:
        os.kill(seeing._process.pid, signal.SIGKILL)
        seeing._process.join()
        with pytest.raises(RuntimeError, match="the camera's process has ended"):
            seeing.check()


def no_camera():
    raise InvalidInputError("no camera is attached")


@pytest.mark.slow
def test_mistakes_of_the_user_are_invalid_input():
    with pytest.raises(InvalidInputError, match=r"^no camera is attached$"):
        Perception(no_camera, calibration()).start()
    first = calibration()
    with pytest.raises(InvalidInputError, match="names no objects"):
        Perception(SlidingTag, CameraCalibration(LENS, CAMERA, {}, first.made))
    larger = type(LENS)(300.0, 300.0, 319.5, 239.5, 640, 480)
    other = CameraCalibration(larger, CAMERA, first.objects, first.made)
    with pytest.raises(InvalidInputError, match="gives 320 x 240 px, but was calibrated at 640 x"):
        Perception(SlidingTag, other).start()


def test_measurements_pass_unchanged_through_shared_memory():
    shared = SharedMeasurements(2, multiprocessing.get_context("spawn"))
    assert shared.since(1) == []
    rng = np.random.default_rng(0)
    written = []
    for number in range(19):
        position, covariance = rng.normal(size=3), rng.normal(size=(3, 3))
        written.append(PositionMeasurement(position, covariance, float(number)))
        shared.write(1, written[-1])
        found = shared.since(1, number - 2.5)
        assert [each.time for each in found] == [w.time for w in written if w.time > number - 2.5]
        for each, true in zip(found, written[-len(found) :], strict=True):
            np.testing.assert_array_equal(each.position, true.position)
            np.testing.assert_array_equal(each.covariance, true.covariance)
        assert shared.since(1, float(number)) == []  # nothing newer
    assert [each.time for each in shared.since(1)] == [14.0, 15.0, 16.0, 17.0, 18.0]
    assert shared.since(0) == []
