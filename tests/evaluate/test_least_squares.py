"""Least squares of the whole state, on motion that is linear and on motion that is not."""

from dataclasses import replace

import numpy as np
from evaluation_worlds import DT, random_run, scene_of

from contactgraph.data import Trajectory
from contactgraph.evaluate.least_squares import fit_least_squares


def springs(count: int, seed: int) -> Trajectory:
    """Bodies on a chain of springs; the first is driven, and a wind pushes all of them."""
    rng = np.random.default_rng(seed)
    position, velocity = rng.normal(size=(2, count, 2))
    control = rng.normal(size=(40, 2))
    states = [(position, velocity)]
    for force in control:
        pull = np.zeros((count, 2))
        pull[:-1] += 5.0 * np.diff(position, axis=0)
        pull[1:] -= 5.0 * np.diff(position, axis=0)
        pull[0] += force
        velocity = velocity + DT * (pull + np.array([0.3, -0.2]))
        position = position + DT * velocity
        states.append((position, velocity))
    positions, velocities = map(np.stack, zip(*states, strict=True))
    return Trajectory(scene_of(count), positions, velocities, control)


def test_linear_motion_is_predicted_exactly():
    fitted = fit_least_squares([springs(3, seed) for seed in range(4)])
    fresh = springs(3, 9)
    found = fitted(fresh, 10)
    assert found.shape == (31, 10, 3, 2)
    windows = np.stack([fresh.position[start + 1 : start + 11] for start in range(31)])
    assert np.allclose(found, windows, atol=1e-5)


def test_every_number_of_nodes_has_its_own_fit():
    fitted = fit_least_squares([springs(2, 0), springs(3, 1), springs(2, 2)])
    assert set(fitted.weights) == {2, 3}
    assert fitted(springs(4, 3), 5) is None
    assert fitted.missing([springs(2, 4), springs(3, 5)]) is None
    reason = fitted.missing([springs(2, 4), springs(5, 5), springs(4, 6)])
    assert reason == (
        "no scene of the training data has 4, 5 nodes, as the test data has; they have 2, 3"
    )


def test_a_body_that_never_moved_is_predicted_to_rest():
    """Its position says nothing in training, whatever it is in a new scene."""
    still = springs(2, 0)
    shape = (41, 1, 2)
    scene = scene_of(3)

    def beside(run: Trajectory, place: float) -> Trajectory:
        position = np.concatenate([run.position, np.full(shape, place)], axis=1)
        velocity = np.concatenate([run.velocity, np.zeros(shape)], axis=1)
        return replace(run, scene=scene, position=position, velocity=velocity)

    fitted = fit_least_squares([beside(still, 0.7), beside(springs(2, 1), 0.7)])
    found = fitted(beside(springs(2, 2), -4.0), 5)
    assert np.allclose(found[:, :, 2], -4.0)


def test_an_unstable_fit_overflows_in_silence():
    run = random_run(2, 6, 0)
    wild = replace(run, position=1e150 * run.position, velocity=-1e150 * run.velocity)
    fitted = fit_least_squares([run])
    assert fitted(wild, 4).shape == (3, 4, 2, 2)
