"""Stamps of frames that cannot be right blind no tracker."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from contactgraph_franka.perception.camera import AHEAD, FrameClock
from contactgraph_franka.perception.tracker import ObjectTracker

RATE, GLITCH_S, SECONDS = 30, 4.0, 8.0


def followed(stamp, of_device: bool) -> np.ndarray:
    """For each frame: time, whether it was taken, whether the object is tracked, and the error."""
    now, rows = [100.0], []
    clock, tracker = FrameClock(lambda: now[0]), ObjectTracker()
    for frame in range(int(SECONDS * RATE)):
        exposed = 100.0 + frame / RATE
        now[0] = exposed + 0.03
        moment = clock.from_device(stamp(exposed)) if of_device else stamp(exposed)
        place = np.array([0.1 * (exposed - 100.0), 0.0, 0.0])
        wrong = moment > now[0] + AHEAD  # as `TrackedObjects` refuses it
        taken = not wrong and tracker.measure(place, 1e-6 * np.eye(3), moment)
        found = tracker.estimate(now[0])
        error = abs(found.position[0] - 0.1 * (now[0] - 100.0))
        rows.append((exposed - 100.0, taken, found.tracked, error * found.tracked))
    return np.array(rows)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2, 1e8), st.integers(1, 10), st.booleans())
def test_frames_ahead_of_the_clock(ahead: float, frames: int, of_device: bool) -> None:
    end = 100.0 + GLITCH_S + (frames - 0.5) / RATE
    rows = followed(lambda t: t + ahead * (100.0 + GLITCH_S - 1e-3 < t < end), of_device)
    after = rows[rows[:, 0] > GLITCH_S + frames / RATE + 0.2]
    assert after[:, 1].all() and after[:, 2].all()
    assert rows[:, 3].max() < 0.03, "where it counts as tracked it is where it seems to be"


@pytest.mark.parametrize("back", [0.5, 50.0, 4294.967296])
def test_a_clock_of_the_device_that_is_set_back(back: float) -> None:
    rows = followed(lambda t: t - back * (t > 100.0 + GLITCH_S), of_device=True)
    after = rows[rows[:, 0] > GLITCH_S + 0.2]
    assert after[:, 1].all() and rows[:, 3].max() < 0.06


def test_a_tracker_by_itself_recovers_from_one_wrong_time() -> None:
    tracker = ObjectTracker()
    for frame in range(60):
        time = frame / RATE + 3600.0 * (frame == 30)
        taken = tracker.measure(np.zeros(3), 1e-6 * np.eye(3), time)
        assert taken == (frame not in (31, 32)), frame
    assert tracker.estimate(59 / RATE).tracked
