"""Detection of impacts, and the rate of windows around them."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    event_steps,
    moving_bodies,
    pad_trajectories,
    strip_contacts,
    window_weights,
)

DT = 0.05


def pickup(seed: int, steps: int = 200) -> tuple[Trajectory, int]:
    """A PD-driven disc that runs into another, sticks to it and carries it to a goal.

    Returns the run and the step within which they meet.
    """
    rng = np.random.default_rng(seed)
    position, goal = np.array([[-0.8, 0.0], [0.3, 0.0], [0.0, 0.9]]), rng.uniform(-1, 1, 2)
    position = position + rng.uniform(-0.2, 0.2, position.shape)
    velocity, noise, impact = np.zeros((3, 2)), np.zeros(2), -1
    states, controls = [(position, velocity)], []
    for step in range(steps):
        noise = 0.8 * noise + 0.3 * rng.normal(size=2)
        target, damping = (position[1], 1.0) if impact < 0 else (goal, 4.0)
        force = 5.0 * (target - position[0]) - damping * velocity[0] + noise
        velocity = velocity.copy()
        velocity[0] += force * DT / (1.0 if impact < 0 else 2.0)
        if impact >= 0:
            velocity[1] = velocity[0]
        position = position + velocity * DT
        if impact < 0 and np.linalg.norm(position[0] - position[1]) < 0.08:
            impact = step
            velocity[:2] = velocity[:2].mean(axis=0)
        states.append((position, velocity))
        controls.append(force)
    scene = Scene(("gripper", "box", "distractor"), ("g", "o", "o"), [True, False, False], DT)
    contact = np.zeros((steps + 1, 3, 3), dtype=bool)
    contact[impact + 1 :, [0, 1], [1, 0]] = True
    states = np.array(states)
    return Trajectory(scene, states[:, 0], states[:, 1], np.array(controls), contact), impact


RUNS, IMPACTS = zip(*(pickup(seed) for seed in range(20)), strict=True)
DATASET = Dataset(RUNS)


def test_all_impacts_are_detected_with_few_false_ones() -> None:
    assert min(IMPACTS) >= 0, "every run has an impact"
    found = event_steps(pad_trajectories(DATASET))
    assert found[np.arange(20), IMPACTS].all()
    assert found.sum() <= 20 + 15, "20 impacts in 4000 steps"


def test_impacts_are_detected_in_noisy_velocities() -> None:
    rng = np.random.default_rng(0)
    noisy = (
        replace(
            trajectory,
            velocity=trajectory.velocity + 0.01 * rng.normal(size=trajectory.velocity.shape),
        )
        for trajectory in RUNS
    )
    found = event_steps(pad_trajectories(Dataset(tuple(noisy))))
    assert found[np.arange(20), IMPACTS].sum() >= 19
    assert found.sum() <= 20 + 10


def test_an_actuated_body_that_hits_a_hidden_wall() -> None:
    rng = np.random.default_rng(0)
    force = 5.0 * np.sin(np.linspace(0, 9, 100))[:, None] + rng.normal(size=(100, 1))
    velocity = np.cumsum(np.vstack([[[3.0]], force * DT]), axis=0)
    velocity[61:] -= velocity[61] + 1.0
    position = np.cumsum(velocity, axis=0) * DT
    scene = Scene(("finger",), ("g",), [True], DT, dimension=1)
    trajectory = Trajectory(scene, position[:, None], velocity[:, None], force)
    np.testing.assert_array_equal(
        np.flatnonzero(event_steps(pad_trajectories(Dataset((trajectory,))))), [60]
    )


def test_a_force_that_jumps_is_no_event_where_the_control_explains_it() -> None:
    force = np.where(np.arange(100) == 50, 30.0, np.sin(np.arange(100)))[:, None]
    velocity = np.cumsum(np.vstack([[[0.0]], force * DT]), axis=0)
    scene = Scene(("finger",), ("g",), [True], DT, dimension=1)
    trajectory = Trajectory(scene, velocity[:, None], velocity[:, None], force)
    assert not event_steps(pad_trajectories(Dataset((trajectory,)))).any()


def test_contacts_and_padding_decide_nothing() -> None:
    found = event_steps(pad_trajectories(DATASET))
    np.testing.assert_array_equal(event_steps(pad_trajectories(strip_contacts(DATASET))), found)
    np.testing.assert_array_equal(event_steps(pad_trajectories(DATASET, 9)), found)
    short = Dataset((*RUNS, still(steps=3), still(steps=260)))
    wide = event_steps(pad_trajectories(short))
    np.testing.assert_array_equal(wide[:20, :200], found)
    assert not wide[:20, 200:].any()


def test_the_end_of_a_short_trajectory_is_no_impact() -> None:
    """Padding is zero: a body that speeds up to the end must not be compared with a stop."""
    steady = np.linspace(0.0, 2.0, 51)[:, None, None] * np.ones((51, 2, 2))
    hasty = steady[:49].copy()
    hasty[-3:] += np.array([0.1, 0.4, 1.0])[:, None, None]
    scene = Scene(("a", "b"), ("o", "o"), [False, False], DT)
    trajectories = (
        Trajectory(scene, each, each, np.zeros((len(each) - 1, 2))) for each in (steady, hasty)
    )
    assert not event_steps(pad_trajectories(Dataset(tuple(trajectories)))).any()


def still(steps: int = 6, nodes: int = 2, control_size: int = 2) -> Trajectory:
    scene = Scene(tuple(f"n{i}" for i in range(nodes)), ("o",) * nodes, np.arange(nodes) == 0, DT)
    state = np.zeros((steps + 1, nodes, 2))
    return Trajectory(scene, state, state, np.zeros((steps, control_size)))


@pytest.mark.parametrize(
    "trajectory",
    [
        still(),
        still(control_size=0),
        still(nodes=1),
        still(nodes=0),
        still(steps=1),
        replace(still(steps=1), velocity=np.arange(8.0).reshape(2, 2, 2)),
    ],
)
def test_data_without_events(trajectory: Trajectory) -> None:
    padded = pad_trajectories(Dataset((trajectory,)))
    assert not event_steps(padded).any()
    windows = window_weights(padded, trajectory.steps)
    assert windows.probability.tolist() == [1.0]


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.6, 1.0])
def test_the_configured_fraction_of_windows_contains_an_event(fraction: float) -> None:
    padded = pad_trajectories(Dataset((*RUNS, still(steps=5), still(steps=30))))
    windows = window_weights(padded, 12, fraction)
    assert windows.probability.sum() == pytest.approx(1.0)
    assert windows.probability[windows.has_event].sum() == pytest.approx(fraction)
    assert len(windows.trajectory) == 20 * 189 + 19, "every window of real steps, once"
    assert len(set(zip(windows.trajectory, windows.start, strict=True))) == 20 * 189 + 19
    lengths = padded.step_mask.sum(axis=1)
    assert np.all(windows.start + 12 <= lengths[windows.trajectory])
    found = event_steps(padded)
    for trajectory, start, has_event in zip(
        windows.trajectory, windows.start, windows.has_event, strict=True
    ):
        assert found[trajectory, start : start + 12].any() == has_event


def test_uniform_where_every_window_contains_an_event() -> None:
    windows = window_weights(pad_trajectories(DATASET), 200)
    np.testing.assert_allclose(windows.probability, 1 / 20)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(((length,), "window_length must be 1 to 200") for length in (0, -1, 201)),
        *(((12, each), "event_fraction must be 0 to 1") for each in (-0.1, 1.1, float("nan"))),
    ],
)
def test_windows_that_are_none(arguments: tuple, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        window_weights(pad_trajectories(DATASET), *arguments)


def test_a_body_that_leaves_and_comes_back_moves():
    position = np.zeros((2, 4, 3, 2))
    position[0, 2, 0] = 0.0008, -0.0008  # 1.13 mm away in one state only
    position[0, 1:, 1, 0] = 0.0009
    position[1, :, 2] = 5.0  # far from the origin, and at rest
    position[1, 3, 1, 1] = -0.002
    expected = [[True, False, False], [False, True, False]]
    assert moving_bodies(position).tolist() == expected
    assert np.asarray(moving_bodies(jnp.asarray(position))).tolist() == expected
