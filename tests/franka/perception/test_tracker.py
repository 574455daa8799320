"""Known answers of the tracker: motion, delay, lost, wrong and doubled frames, impulses."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph_franka.perception import ObjectTracker
from contactgraph_franka.perception.tracker import FREE, GRASPED, FilterState, predicted

NOISE = 5e-4
COVARIANCE = NOISE**2 * np.eye(3)
RATE = 30.0
SPEED = np.array([0.3, -0.2, 0.1])


def watched(tracker, path, frames, rng=None):
    """Shows the tracker ``path`` at the numbered frames; returns how many counted."""
    counted = 0
    for number in frames:
        noise = 0.0 if rng is None else rng.normal(0.0, NOISE, 3)
        counted += tracker.measure(path(number / RATE) + noise, COVARIANCE, number / RATE)
    return counted


def straight(time):
    return np.array([0.4, 0.1, 0.2]) + SPEED * time


def test_constant_velocity_is_learned_and_predicted_through_the_delay():
    tracker = ObjectTracker()
    watched(tracker, straight, range(40))
    last = 39 / RATE
    for delay in (0.0, 0.03, 0.08):
        estimate = tracker.estimate(last + delay)
        np.testing.assert_allclose(estimate.velocity, SPEED, atol=1e-4)
        np.testing.assert_allclose(estimate.position, straight(last + delay), atol=1e-5)
        assert estimate.tracked and estimate.time == last


def test_errors_agree_with_the_variance():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(200):
        tracker = ObjectTracker()
        velocity, position, places = np.zeros(3), np.zeros(3), []
        step = 1.0 / RATE
        for _ in range(20):
            # The very motion the filter assumes: white acceleration, integrated exactly.
            root = np.linalg.cholesky([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
            moved, faster = np.sqrt(FREE.density) * root @ rng.normal(size=(2, 3))
            position = position + step * velocity + moved
            velocity = velocity + faster
            places.append(position)
        watched(tracker, lambda time, places=places: places[round(time * RATE)], range(20), rng)
        estimate = tracker.estimate(19 / RATE)
        ratios.append((estimate.position - position) ** 2 / estimate.variance)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_lost_frames_only_raise_the_variance():
    tracker, seen_always = ObjectTracker(), ObjectTracker()
    watched(tracker, straight, [*range(20), 24])
    watched(seen_always, straight, range(25))
    now = 24 / RATE + 0.03
    estimate, other = tracker.estimate(now), seen_always.estimate(now)
    np.testing.assert_allclose(estimate.position, straight(now), atol=1e-4)
    assert (estimate.variance > other.variance).all() and estimate.tracked


def test_an_object_is_lost_after_a_fifth_of_a_second():
    tracker = ObjectTracker()
    watched(tracker, straight, range(20))
    last = 19 / RATE
    # The clocks of frame and reader may differ by 0.1 s.
    for since, tracked in ((-1.0, False), (-0.05, True), (0.19, True), (0.21, False)):
        assert tracker.estimate(last + since).tracked == tracked
    assert np.isfinite(tracker.estimate(last + 60.0).position).all()


def test_an_unseen_object_is_unknown_and_an_uncertain_one_not_tracked():
    tracker = ObjectTracker()
    estimate = tracker.estimate(1.0)
    assert not estimate.tracked and estimate.time == -np.inf
    assert np.isinf(estimate.variance).all()
    tracker.measure(np.zeros(3), 0.06**2 * np.eye(3), 0.0)
    assert not tracker.estimate(0.0).tracked


def test_an_outlier_does_not_count():
    tracker = ObjectTracker()
    watched(tracker, straight, range(20))
    assert not tracker.measure(
        straight(20 / RATE) + np.array([0.0, 0.1, 0.0]), COVARIANCE, 20 / RATE
    )
    assert tracker.measure(straight(21 / RATE), COVARIANCE, 21 / RATE)
    np.testing.assert_allclose(tracker.estimate(0.8).position, straight(0.8), atol=1e-4)


def test_an_object_moved_elsewhere_is_accepted_after_three_frames():
    tracker = ObjectTracker()
    watched(tracker, straight, range(20))

    def elsewhere(time):
        return straight(time) + np.array([0.0, 0.3, 0.0])

    assert watched(tracker, elsewhere, [20, 21]) == 0
    assert watched(tracker, elsewhere, [22]) == 1
    estimate = tracker.estimate(22 / RATE)
    np.testing.assert_allclose(estimate.position, elsewhere(22 / RATE), atol=1e-3)
    assert tracker.state.begun == 20 / RATE


def test_inconsistent_outliers_are_never_accepted():
    tracker, rng = ObjectTracker(), np.random.default_rng(0)
    watched(tracker, straight, range(20))
    for number in range(20, 40):
        place = np.array([4.0, 0.0, 0.0]) + rng.uniform(-0.5, 0.5, 3)
        assert not tracker.measure(place, COVARIANCE, number / RATE)


def test_a_blow_is_followed_within_two_frames():
    tracker = ObjectTracker()

    def struck(time):
        return np.array([0.5 * max(0.0, time - 0.71), 0.0, 0.0])

    assert watched(tracker, struck, range(24)) == 24  # one frame, 0.057 s, after the impulse
    estimate = tracker.estimate(24 / RATE)
    np.testing.assert_allclose(estimate.velocity, [0.5, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(estimate.position, struck(24 / RATE), atol=5e-3)


@pytest.mark.parametrize("time", [19 / RATE, 10 / RATE, -np.inf, np.nan, np.inf])
def test_frames_that_are_old_or_doubled_change_nothing(time):
    tracker = ObjectTracker()
    watched(tracker, straight, range(20))
    before = tracker.state
    assert not tracker.measure(np.zeros(3), COVARIANCE, time)
    assert tracker.state is before


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_measurements_that_are_not_finite_are_ignored(bad):
    tracker = ObjectTracker()
    assert not tracker.measure(np.full(3, bad), COVARIANCE, 0.0)
    assert not tracker.measure(np.zeros(3), np.full((3, 3), bad), 0.0)
    assert tracker.state is None


def test_the_predicted_covariance_is_the_textbooks():
    root = np.random.default_rng(0).normal(size=(6, 6))
    step, forward = 0.04, np.eye(6)
    forward[:3, 3:] = step * np.eye(3)
    process = np.kron([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], np.eye(3))
    expected = forward @ (root @ root.T) @ forward.T + 0.7 * process
    np.testing.assert_allclose(predicted(root @ root.T, step, 0.7), expected, atol=1e-12)
    estimate = FilterState(2.0, np.zeros(6), root @ root.T).estimate(
        2.0 + step, replace(FREE, density=0.7)
    )
    np.testing.assert_allclose(estimate.variance, np.diag(expected)[:3], atol=1e-12)


def test_a_block_that_was_just_struck_is_not_lost():
    """Frames come every 0.033 s with 0.04 s delay: an impact shows 0.07 s late."""
    tracker = ObjectTracker()
    for frame in range(10):
        tracker.measure(
            np.array([0.4 * max(0.0, frame - 7.5) / 30.0, 0.0, 0.0]),
            2.5e-7 * np.eye(3),
            frame / 30.0,
        )
        assert tracker.estimate(frame / 30.0 + 0.08).tracked or frame < 2


def test_a_grasped_object_has_no_impacts_and_ignores_a_wrong_tilt():
    free, held = ObjectTracker(), ObjectTracker()
    for frame in range(40):
        observed = np.zeros(3)
        if frame in (20, 21, 22, 30):
            observed = np.array([0.028, 0.0, 0.028])  # as a lone tag that leans to the other side
        free.measure(observed, 1e-6 * np.eye(3), frame / 30.0)
        counts = held.measure(observed, 1e-6 * np.eye(3), frame / 30.0, GRASPED)
        assert counts == (not observed.any())
        if frame == 22:
            assert np.linalg.norm(free.estimate(frame / 30.0 + 0.05).position) > 0.02
    estimate = held.estimate(40 / 30.0)
    np.testing.assert_allclose(estimate.position, 0.0, atol=1e-3)
    np.testing.assert_allclose(estimate.velocity, 0.0, atol=1e-2)


def test_a_gap_of_seconds_is_a_new_start():
    tracker = ObjectTracker()
    for frame in range(30):
        tracker.measure(np.array([0.5 * frame / 30.0, 0.0, 0.0]), 1e-6 * np.eye(3), frame / 30.0)
    tracker.measure(np.zeros(3), 1e-6 * np.eye(3), 3.0)
    assert tracker.state.begun == 3.0
    np.testing.assert_array_equal(tracker.state.mean, np.zeros(6))
