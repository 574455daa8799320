import numpy as np

from contactgraph.envs import RestPolicy, SpringsTask
from contactgraph.envs.episodes import run_episode
from contactgraph.envs.relation_tasks import SPRING_STIFFNESS, SpringWorld


def test_springs_keep_momentum_and_energy_and_their_graph():
    run = run_episode(SpringsTask(), RestPolicy(), 3)
    momentum = run.velocity.sum(axis=1)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (50, 1)), atol=1e-8)
    joined = run.contact[0]
    assert np.array_equal(run.contact, np.tile(joined, (50, 1, 1)))
    apart = np.linalg.norm(run.position[:, :, None] - run.position[:, None], axis=-1)
    energy = 0.5 * (run.velocity**2).sum(axis=(1, 2))
    energy += 0.25 * SPRING_STIFFNESS * (joined * apart**2).sum(axis=(1, 2))
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)


def test_half_of_the_pairs_are_joined():
    task, pairs = SpringsTask(), np.triu_indices(5, 1)
    joined = [task.reset(seed=seed)[0]["contact"][pairs].mean() for seed in range(200)]
    assert abs(np.mean(joined) - 0.5) < 4 * 0.5 / np.sqrt(2000)


def test_two_bodies_on_a_spring_swing_as_the_formula_says():
    dt, joined = 0.1, np.array([[False, True], [True, False]])
    first = np.array([[-0.5, 0.0], [0.5, 0.0]])
    world = SpringWorld(first, np.zeros((2, 2)), joined, dt)
    for _ in range(40):
        world.step(np.zeros((2, 2)))
    swing = 0.5 * np.cos(np.sqrt(2.0 * SPRING_STIFFNESS) * 40 * dt)
    np.testing.assert_allclose(world.position[:, 0], [-swing, swing], atol=1e-9)


def test_a_force_moves_the_middle_of_joined_bodies():
    joined = np.array([[False, True], [True, False]])
    world = SpringWorld(np.array([[-0.5, 0.0], [0.5, 0.0]]), np.zeros((2, 2)), joined, 0.1)
    for _ in range(10):
        world.step(np.array([[0.0, 1.0], [0.0, 0.0]]))
    np.testing.assert_allclose(world.position.mean(axis=0), [0.0, 0.25], atol=1e-12)
