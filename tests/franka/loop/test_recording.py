"""Recorded episodes become trajectories; tracks are smoothed with later frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scripted import ConstantForce, Delayed, Scripted, StepTime

from contactgraph.data import InvalidInputError, Scene, read_trajectories, write_trajectories
from contactgraph_franka.loop import ControlLoop
from contactgraph_franka.perception.tracked_objects import GraspOffsetHistory, Track
from contactgraph_franka.perception.tracker import ObjectTracker
from contactgraph_franka.recording import TrajectoryRecorder, smooth_track
from contactgraph_franka.safety import FakeRobot, RobotReading, SafeRobot, SafetyLimits
from contactgraph_franka.safety.faults import Fault, lost_packet_fault

SCENE = Scene(("hand", "block"), ("hand", "block"), np.array([True, False]), 0.01, 3)
GOAL = np.array([0.5, 0.0, 0.3])


def recorded(seconds: float, *faults: Fault) -> TrajectoryRecorder:
    robot = FakeRobot(0, faults)
    clock = StepTime(robot)
    recorder = TrajectoryRecorder(seconds, 2)
    planning = Delayed(Scripted(lambda _: ConstantForce((3.0, 1.0, 0.0))), clock)
    loop = ControlLoop(SafeRobot(robot, SafetyLimits(), clock), planning, clock)
    loop.run(seconds, GOAL, on_cycle=recorder)
    return recorder


def test_trajectory_moves_by_its_controls(tmp_path: Path) -> None:
    trajectory = recorded(0.4).trajectory(SCENE)
    assert trajectory is not None
    assert trajectory.scene.dt == 0.001 and 395 <= trajectory.steps <= 405
    # The fake hand weighs 4 kg: steps of 1 ms under the recorded forces lead where it went.
    gained = np.diff(trajectory.velocity[:, 0], axis=0)
    np.testing.assert_allclose(gained, trajectory.control / 4.0 * 0.001, atol=1e-9)
    assert trajectory.contact is not None and not trajectory.contact.any()
    assert trajectory.tracked is not None and trajectory.tracked.all()
    assert trajectory.measured_at is not None
    np.testing.assert_allclose(
        trajectory.measured_at[:, 0], np.arange(trajectory.steps + 1) * 0.001, atol=1e-9
    )
    write_trajectories(tmp_path / "trajectory.h5", [trajectory])
    (again,) = read_trajectories(tmp_path / "trajectory.h5")
    np.testing.assert_array_equal(again.position, trajectory.position)
    np.testing.assert_array_equal(again.tracked, trajectory.tracked)


def test_lost_readings_are_interpolated() -> None:
    whole = recorded(0.2).trajectory(SCENE)
    lost = recorded(0.2, lost_packet_fault(50, 52)).trajectory(SCENE)
    assert whole is not None and lost is not None
    near = slice(0, 60)
    np.testing.assert_allclose(lost.position[near], whole.position[near], atol=2e-4)


def test_no_trajectory_without_sent_forces() -> None:
    recorder = TrajectoryRecorder(0.1, 2)
    reading = FakeRobot().read()
    assert reading is not None
    recorder(0.0, reading, None)
    assert recorder.trajectory(SCENE) is None
    recorder(0.001, None, np.zeros(3))
    recorder(0.002, None, np.zeros(3))
    assert recorder.trajectory(SCENE) is not None
    recorder.reset()
    assert recorder.trajectory(SCENE) is None


def test_unmeasured_contact_is_not_recorded() -> None:
    contact = np.full((2, 2), np.nan)
    for known in (False, True):
        recorder = TrajectoryRecorder(0.1, 2)
        for cycle in range(5):
            touch = contact.copy()
            touch[0, 1] = touch[1, 0] = 0.9 if known or cycle else np.nan
            now = 0.001 * cycle
            reading = RobotReading(
                np.zeros((2, 3)), np.zeros((2, 3)), np.full(2, now), now, np.ones(2), contact=touch
            )
            recorder(now, reading, np.zeros(3))
        trajectory = recorder.trajectory(SCENE)
        assert trajectory is not None and (trajectory.contact is not None) == known
        assert not known or (
            trajectory.contact[:, 0, 1].all() and not trajectory.contact[:, 0, 0].any()
        )


def test_cycles_beyond_the_capacity_are_left_out() -> None:
    recorder = TrajectoryRecorder(0.1, 2)
    reading = FakeRobot().read()
    assert reading is not None
    for cycle in range(1000):
        now = 0.001 * cycle
        recorder(now, replace(reading, time=np.full(2, now)), np.zeros(3))
    trajectory = recorder.trajectory(SCENE)
    assert trajectory is not None and trajectory.steps == 199


@pytest.mark.parametrize("times", [(0.0, 0.001), (0.1, 0.0), (float("inf"), 0.001)])
def test_invalid_times(times: tuple[float, float]) -> None:
    with pytest.raises(InvalidInputError, match="seconds and period must be positive"):
        TrajectoryRecorder(times[0], 2, period=times[1])


def along_x(way: np.ndarray) -> np.ndarray:
    return np.stack([way, 0.0 * way, 0.0 * way], axis=1)


def swept(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rests for a second, then is accelerated to 0.4 m/s within 0.3 s."""
    s = np.clip((time - 1.0) / 0.3, 0.0, None)
    speed = 0.4 * np.where(
        s < 1.0, 3.0 * np.minimum(s, 1.0) ** 2 - 2.0 * np.minimum(s, 1.0) ** 3, 1.0
    )
    way = 0.12 * np.where(s < 1.0, s**3 - s**4 / 2.0, 0.5 + (s - 1.0))
    return along_x(way), along_x(speed)


def tracked(positions: np.ndarray) -> Track:
    """The track of an object that is never grasped, measured at 30 Hz to a millimetre."""
    tracker, states = ObjectTracker(), []
    for frame, position in enumerate(positions):
        if tracker.measure(position, 1e-6 * np.eye(3), frame / 30.0):
            assert tracker.state is not None
            states.append(tracker.state)
    return Track(GraspOffsetHistory(1), 0, states)


def test_smoothing_removes_the_lag() -> None:
    at = np.arange(0.5, 2.5, 0.001)
    truth, speed = swept(at)
    errors = []
    for seed in range(5):
        random = np.random.default_rng(seed)
        places = swept(np.arange(90) / 30.0)[0]
        track = tracked(places + 0.001 * random.standard_normal(places.shape))
        position, velocity = smooth_track(track, at)
        live = [next(s for s in reversed(track.states) if s.time <= t - 0.03) for t in at]
        guess = np.stack([s.estimate(t).velocity for s, t in zip(live, at, strict=True)])
        errors.append(
            [
                np.sqrt(np.mean(np.sum((position - truth) ** 2, axis=1))),
                np.sqrt(np.mean(np.sum((velocity - speed) ** 2, axis=1))),
                np.sqrt(np.mean(np.sum((guess - speed) ** 2, axis=1))),
            ]
        )
    position_error, velocity_error, live_error = np.mean(errors, axis=0)
    assert position_error < 0.0010
    assert velocity_error < 0.03 and velocity_error < 0.5 * live_error


def test_straight_motion_is_exact() -> None:
    at = np.array([-0.1, 0.0, 0.25, 0.31, 0.9])
    position, velocity = smooth_track(tracked(along_x(0.1 * np.arange(20) / 30.0)), at)
    np.testing.assert_allclose(velocity[:, 0], 0.1, atol=1e-3)
    np.testing.assert_allclose(position[:, 0], 0.1 * at, atol=3e-4)


def test_no_smoothing_across_a_restart_of_the_filter() -> None:
    track = tracked(along_x(0.4 * (np.arange(40) >= 20)))
    position, _ = smooth_track(track, np.array([0.5, 0.6, 0.75, 1.0]))
    np.testing.assert_allclose(position[:2, 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(position[2:, 0], 0.4, atol=1e-3)


def test_object_in_no_frame() -> None:
    with pytest.raises(InvalidInputError, match="the object was in no frame"):
        smooth_track(tracked(np.zeros((0, 3))), np.zeros(3))
