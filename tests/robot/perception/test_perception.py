"""Seeing in a process of its own, with the real detector on drawn tags."""

import multiprocessing
import os
import signal
import time
from functools import partial

import numpy as np
import pytest
from drawn_tags import CAMERA, LENS, SIZE, SlidingTag, calibration, drawn

from contactgraph.data import InvalidInputError
from contactgraph.robot.perception import CameraCalibration, CameraFrame
from contactgraph.robot.perception.shared_tracks import SharedTracks, TrackCounts
from contactgraph.robot.perception.tracker import FilterState

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph.robot.perception.perception import Perception
from contactgraph.robot.perception.sight import Sight
from contactgraph.robot.perception.watch import Watch

DISTANCE = LENS.fx * SIZE / 48.0
"""m: a tag of 48 px."""


def expected(column):
    """[3] m in the base: of a tag drawn at this column, 80 rows down."""
    centre = np.array([column + 29.5, 80 + 29.5])
    ray = np.append((centre - (LENS.cx, LENS.cy)) / LENS.fx, 1.0)
    return CAMERA[:3, :3] @ (DISTANCE * ray) + CAMERA[:3, 3]


def test_a_drawn_tag_is_seen_where_it_is_drawn():
    seen = Sight(calibration()).see(CameraFrame(drawn([(3, 100, 80)]), None, 5.0))
    np.testing.assert_allclose(seen["block"].position, expected(100), atol=3e-4)
    assert seen["block"].tags == (3,) and seen["block"].time == 5.0
    # It faces the camera, upright.
    np.testing.assert_allclose(seen["block"].pose[:3, 2], [1.0, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(seen["block"].pose[:3, 1], [0.0, 0.0, 1.0], atol=0.02)
    spread = np.sqrt(np.diag(seen["block"].covariance))
    assert (spread < 2e-3).all() and spread[0] == spread.max()


def test_what_is_not_there_is_not_seen():
    assert Sight(calibration()).see(CameraFrame(drawn([(4, 100, 80)]), None, 5.0)) == {}


class Frames:
    """A camera that shows the given frames, one a call."""

    intrinsics = LENS

    def __init__(self, frames):
        self._frames = iter(frames)

    def read(self):
        return next(self._frames, None)


def test_frames_are_counted_and_only_what_counts_moves_the_track():
    at = [CameraFrame(drawn([(3, 100, 80)]), None, 0.01 * number) for number in range(3)]
    empty = CameraFrame(drawn([]), None, 0.03)
    frames = [*at, empty, at[2], CameraFrame(drawn([(3, 220, 80)]), None, 0.04)]
    tracks = SharedTracks(1, multiprocessing.get_context("spawn"))
    watch = Watch(Frames(frames), calibration(), tracks, lambda: 0.05)
    assert [watch.look() for _ in range(7)] == [True] * 6 + [False]
    # Of the last three: not there, seen before, and too far away to be true.
    assert tracks.counts(0) == TrackCounts(frames=6, lost=1, refused=2)
    assert tracks.state(0).time == pytest.approx(0.02)
    count, mean, longest = tracks.latency()
    assert count == 6 and mean == pytest.approx(0.03) and longest == pytest.approx(0.05)


def test_a_process_tells_where_the_object_is_and_how_fast():
    with Perception(SlidingTag, calibration()) as seeing:
        until = time.monotonic() + 20.0
        while time.monotonic() < until:
            seeing.check()
            now = time.monotonic()
            estimate = seeing.estimates(now)["block"]
            if seeing.report().frames > 12 and estimate.tracked:
                break
            time.sleep(0.005)
        report = seeing.report()
    assert estimate.tracked and 0.0 <= now - estimate.time < 0.2
    # A pixel every 20 ms: to the camera's right, which is the base's y.
    speed = DISTANCE / LENS.fx / 0.02
    np.testing.assert_allclose(estimate.velocity, [0.0, speed, 0.0], atol=0.04)
    assert report.frames > 12 and report.objects["block"].lost == 0
    assert 0.0 < report.latency <= report.longest_latency


def test_what_goes_wrong_in_the_process_is_told():
    seeing = Perception(partial(SlidingTag, 3), calibration())
    until = time.monotonic() + 20.0
    with pytest.raises(RuntimeError, match="the cable is out"):
        seeing.start()  # on a busy machine the cable is out before this returns
        while time.monotonic() < until:
            seeing.check()
            time.sleep(0.01)
    seeing.close()


def test_a_process_that_is_gone_is_told():
    with Perception(SlidingTag, calibration()) as seeing:
        os.kill(seeing._process.pid, signal.SIGKILL)
        seeing._process.join()
        with pytest.raises(RuntimeError, match="the camera's process has ended"):
            seeing.check()


def no_camera():
    raise InvalidInputError("no camera is attached")


def test_the_users_mistakes_are_told_as_such():
    with pytest.raises(InvalidInputError, match=r"^no camera is attached$"):
        Perception(no_camera, calibration()).start()
    told = calibration()
    with pytest.raises(InvalidInputError, match="names no objects"):
        Perception(SlidingTag, CameraCalibration(LENS, CAMERA, {}, told.made))
    larger = type(LENS)(300.0, 300.0, 319.5, 239.5, 640, 480)
    other = CameraCalibration(larger, CAMERA, told.objects, told.made)
    with pytest.raises(InvalidInputError, match="gives 320 x 240 px, but was calibrated at 640 x"):
        Perception(SlidingTag, other).start()


def test_states_come_whole_through_shared_memory():
    tracks = SharedTracks(2, multiprocessing.get_context("spawn"))
    assert tracks.state(1) is None and tracks.counts(1) == TrackCounts(0, 0, 0)
    rng = np.random.default_rng(0)
    for number in range(9):
        covariance = rng.normal(size=(6, 6))
        told = FilterState(float(number), rng.normal(size=6), covariance, -1.0, 0.5)
        tracks.write(1, told, TrackCounts(number, 2, 3))
        found = tracks.state(1)
        assert (found.time, found.begun, found.density) == (float(number), -1.0, 0.5)
        np.testing.assert_array_equal(found.mean, told.mean)
        np.testing.assert_array_equal(found.covariance, told.covariance)
        assert tracks.counts(1) == TrackCounts(number, 2, 3)
    assert tracks.state(0) is None
