"""Objects with delayed camera measurements, carried by a hand."""

from functools import cache

import numpy as np
import pytest

from contactgraph_franka.perception.tracked_objects import GraspOffsetHistory, TrackedObjects
from contactgraph_franka.perception.tracker import PositionMeasurement
from contactgraph_franka.recording import smooth_track

RATE, DELAY, NOISE = 30.0, 0.055, 0.001
GRASPED, REPORTED = 1.0, 1.035
"""s: the times of the grasp and of its report."""


class Frames:
    """The newest measurement by name."""

    def __init__(self) -> None:
        self.measurements: dict[str, PositionMeasurement] = {}

    def since(self, name: str, after: float) -> list[PositionMeasurement]:
        objects = self.measurements.get(name)
        return [objects] if objects is not None and objects.time > after else []


def hand(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Comes to the block at 0.4 m/s along x, stops in 0.1 s, rests and goes back as fast, faster
    than white acceleration explains."""
    since = time - GRASPED
    way = np.array([0.5 + 0.4 * since, 0.0, 0.05])
    if since > 0.0:
        way[0] = 0.5 + 0.4 * min(since, 0.1) - 2.0 * min(since, 0.1) ** 2
        speed = 0.4 - 4.0 * since if since < 0.1 else 0.0
        back = max(0.0, since - 0.2)
        swing = 0.12 * np.sin(6.0 * back) ** 2
        return way - [swing, 0.0, 0.0], np.array(
            [speed - 0.72 * np.sin(12.0 * back) * (back > 0.0), 0.0, 0.0]
        )
    return way, np.array([0.4, 0.0, 0.0])


def block(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Rests until it is grasped, and is in the hand from then on."""
    return hand(time) if time >= GRASPED else (np.array([0.5, 0.0, 0.05]), np.zeros(3))


@cache
def lived(
    hold: bool, hidden: tuple[float, float] = (9.0, 9.0)
) -> tuple[TrackedObjects, list[tuple[float, float, bool]]]:
    """Tracks over 2 s: errors [m, m/s] and validity of each cycle."""
    source, random = Frames(), np.random.default_rng(0)
    objects = TrackedObjects(source, ("block",))
    waiting: list[PositionMeasurement] = []
    exposed, found = 0.0, []
    for now in np.arange(0.0, 2.0, 0.001):
        if now >= exposed:
            if not hidden[0] < now < hidden[1]:
                there = block(now)[0] + NOISE * random.standard_normal(3)
                waiting.append(PositionMeasurement(there, NOISE**2 * np.eye(3), now))
            exposed += 1.0 / RATE
        if waiting and now >= waiting[0].time + DELAY:
            source.measurements["block"] = waiting.pop(0)
        objects.follow(*hand(now), now, 0, float(hold and now >= REPORTED))
        (estimate,) = objects.estimates(now)
        place, speed = block(now)
        off = np.linalg.norm(estimate.position - place), np.linalg.norm(estimate.velocity - speed)
        found.append((float(off[0]), float(off[1]), estimate.tracked))
    return objects, found


def test_a_grasped_object_follows_the_hand_despite_late_frames() -> None:
    _, known = lived(hold=True)
    _, unknown = lived(hold=False)
    after = slice(1150, 2000)
    error, without = np.array(known)[after], np.array(unknown)[after]
    assert error[:, 0].max() < 0.004 and np.sqrt(np.mean(error[:, 1] ** 2)) < 0.03
    # The same frames alone lag by centimetres.
    assert without[:, 0].max() > 0.02 and np.sqrt(np.mean(without[:, 1] ** 2)) > 0.3


def test_a_hidden_object_is_tracked_while_grasped() -> None:
    _, found = lived(hold=True, hidden=(1.1, 1.7))
    errors = np.array([each[0] for each in found])
    assert errors[1150:].max() < 0.01
    assert all(each[2] for each in found[100:])
    _, lost = lived(hold=False, hidden=(1.1, 1.7))
    assert not all(each[2] for each in lost[1300:1700])


def test_an_object_hidden_for_long_is_lost_although_grasped() -> None:
    _, found = lived(hold=True, hidden=(0.5, 9.0))
    assert found[1400][2] and not found[1700][2]


def test_smoothing_follows_the_carrier() -> None:
    objects, _ = lived(hold=True)
    at = np.arange(0.2, 1.9, 0.001)
    position, velocity = smooth_track(objects.tracks[1], at)
    truth = [block(time) for time in at]
    error = np.linalg.norm(position - [each[0] for each in truth], axis=1)
    late = np.linalg.norm(velocity - [each[1] for each in truth], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.001 and error.max() < 0.003
    # When it was grasped, is known to some milliseconds.
    grasp = np.abs(at - GRASPED) < 0.05
    assert np.sqrt(np.mean(late[~grasp] ** 2)) < 0.02


def test_a_false_report_of_a_grasp_does_not_move_the_object() -> None:
    source = Frames()
    objects = TrackedObjects(source, ("block",))
    place = np.array([0.5, 0.0, 0.05])
    for cycle in range(1500):
        now = 0.001 * cycle
        if cycle % 33 == 0:
            source.measurements["block"] = PositionMeasurement(place, 1e-6 * np.eye(3), now)
        gone = np.array([0.3 * max(0.0, now - 0.5), 0.0, 0.0])
        objects.follow(gone, np.array([0.3, 0.0, 0.0]), now, 0, float(now > 0.5))
        (estimate,) = objects.estimates(now)
        if now > 0.8:
            np.testing.assert_allclose(estimate.position, place, atol=0.012)


def test_estimates_are_in_the_order_of_nodes_and_are_kept() -> None:
    source = Frames()
    objects = TrackedObjects(source, ("block", "other"))
    assert [one.tracked for one in objects.estimates(0.0)] == [False, False]
    for time in (0.1, 0.2):
        source.measurements["block"] = PositionMeasurement(np.full(3, time), 1e-6 * np.eye(3), time)
        for _ in range(3):
            estimates = objects.estimates(time)
        assert [one.tracked for one in estimates] == [True, False]
    assert [state.time for state in objects.tracks[1].states] == [0.1, 0.2]
    assert not objects.tracks[2].states
    objects.begin()
    assert not objects.tracks[1].states


def test_a_grasp_is_dated_back_by_the_delay_of_the_fingers() -> None:
    path = GraspOffsetHistory(2)
    for cycle in range(200):
        hand_at = np.array([0.001 * cycle, 0.0, 0.0])
        held = 1 if 100 <= cycle < 150 else None
        path.append(hand_at, np.array([1.0, 0.0, 0.0]), 0.001 * cycle, held)
    # Reported at 0.1 s, 0.035 s after the grasp; released at 0.15 s.
    np.testing.assert_allclose(path.displacement(1, 0.12), [0.12 - 0.065, 0.0, 0.0], atol=2.1e-3)
    np.testing.assert_allclose(path.displacement(1, 5.0), [0.15 - 0.065, 0.0, 0.0], atol=2.1e-3)
    np.testing.assert_array_equal(path.displacement(0, 5.0), np.zeros(3))
    moved, speed = path.motion(1, np.array([0.0, 0.05, 0.11, 0.18]))
    np.testing.assert_allclose(speed[:, 0], [0.0, 0.0, 1.0, 0.0])
    assert moved[0, 0] == moved[1, 0] == 0.0 < moved[2, 0] < moved[3, 0]
    before = path.displacement(1, 5.0)
    path.begin()
    np.testing.assert_array_equal(path.displacement(1, 5.0), before)


def test_a_pause_between_notes_carries_nothing() -> None:
    path = GraspOffsetHistory(1)
    path.append(np.zeros(3), np.zeros(3), 0.0, 0)
    path.append(np.ones(3), np.zeros(3), 1.0, 0)
    np.testing.assert_array_equal(path.displacement(0, 1.0), np.zeros(3))
    path.append(np.zeros(3), np.zeros(3), 0.5, 0)  # older than the last
    assert path.velocity(0) == pytest.approx(np.zeros(3))


def test_a_path_grows() -> None:
    path = GraspOffsetHistory(1)
    for cycle in range(70_000):
        path.append(np.array([1e-6 * cycle, 0.0, 0.0]), np.zeros(3), 0.001 * cycle, 0)
    assert path.displacement(0, 99.0)[0] == pytest.approx(0.069999)
