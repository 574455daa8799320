"""Subsampled trajectories describe the same motion."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    subsample,
    without_turns,
)


def thrown(steps: int, dt: float) -> Trajectory:
    """A body under a force that changes in every step, and a second one that is touched once."""
    random = np.random.default_rng(0)
    control = random.standard_normal((steps, 2))
    velocity = np.zeros((steps + 1, 2, 2))
    velocity[1:, 0] = np.cumsum(control, axis=0) * dt
    position = np.zeros((steps + 1, 2, 2))
    position[1:] = np.cumsum(velocity[:-1], axis=0) * dt
    contact = np.zeros((steps + 1, 2, 2), dtype=bool)
    contact[10, 0, 1] = contact[10, 1, 0] = True
    scene = Scene(("hand", "block"), ("hand", "block"), np.array([True, False]), dt)
    tracked = random.random((steps + 1, 2)) > 0.5
    measured_at = random.random((steps + 1, 2))
    return Trajectory(scene, position, velocity, control, contact, None, tracked, measured_at)


def test_every_fifth_state_and_the_mean_control() -> None:
    trajectory = thrown(23, 0.001)
    (longer,) = subsample(Dataset((trajectory,), {"lab": "here"}), 5)
    assert longer.scene.dt == pytest.approx(0.005) and longer.steps == 4
    np.testing.assert_array_equal(longer.position, trajectory.position[[0, 5, 10, 15, 20]])
    np.testing.assert_array_equal(longer.tracked, trajectory.tracked[[0, 5, 10, 15, 20]])
    np.testing.assert_array_equal(longer.measured_at, trajectory.measured_at[[0, 5, 10, 15, 20]])
    # A mass of 1 kg: momentum is what the mean force gives in the longer step.
    gained = longer.velocity[1:, 0] - longer.velocity[:-1, 0]
    np.testing.assert_allclose(gained, longer.control * 0.005, atol=1e-12)


def test_a_control_without_components() -> None:
    trajectory = replace(thrown(20, 0.001), control=np.zeros((20, 0)))
    (longer,) = subsample(Dataset((trajectory,)), 5)
    assert longer.control.shape == (4, 0)


def test_a_touch_between_two_states_is_one_at_the_second() -> None:
    (longer,) = subsample(Dataset((thrown(20, 0.001),)), 5)
    assert longer.contact is not None
    np.testing.assert_array_equal(longer.contact[:, 0, 1], [False, False, True, False, False])


def test_invalid_subsampling() -> None:
    dataset = Dataset((thrown(20, 0.001),), {"lab": "here"})
    assert subsample(dataset, 1) is dataset
    assert subsample(dataset, 20).metadata == {"lab": "here"}
    with pytest.raises(InvalidInputError, match="every must be at least 1, found 0"):
        subsample(dataset, 0)
    with pytest.raises(InvalidInputError, match="every must be 1 to 20, a trajectory's"):
        subsample(dataset, 21)


def test_bodies_without_turns_have_the_rest() -> None:
    points = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    trajectory = thrown(23, 0.001)
    scene = replace(trajectory.scene, polygons=(points,), polygon_of=np.array([1]))
    turns = np.zeros((24, 2, 1))
    turning = replace(trajectory, scene=scene, orientation=turns, angular_velocity=turns)
    (round_,) = without_turns(Dataset((turning,)))
    assert np.isnan(round_.orientation).all() and np.isnan(round_.angular_velocity).all()
    assert round_.scene.polygons == () and not len(round_.scene.polygon_of)
    assert round_.scene.outlines_of(1) == trajectory.scene.outlines_of(1)
    np.testing.assert_array_equal(round_.position, trajectory.position)
