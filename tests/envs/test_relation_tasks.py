import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from contactgraph.data import InvalidInputError
from contactgraph.envs import AttractionTask, RestPolicy, SpringsTask, check_task
from contactgraph.envs.episodes import run_episode
from contactgraph.envs.relation_tasks import (
    ATTRACTION,
    ATTRACTION_RADIUS,
    SOFTENING,
    SPRING_STIFFNESS,
    SmoothWorld,
)


@pytest.mark.parametrize("task", [SpringsTask, AttractionTask])
def test_the_tasks_keep_the_contract(task):
    check_task(lambda: _shortened(task))
    spec = EnvSpec("Relations-v0", entry_point=task, disable_env_checker=True)
    check_env(spec.make().unwrapped, skip_render_check=True)


def _shortened(task):
    made = task()
    made.max_steps = 12
    return made


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
    dt = 0.1
    pull = SPRING_STIFFNESS * np.array([[-1.0, 1.0], [1.0, -1.0]])
    first = np.array([[-0.5, 0.0], [0.5, 0.0]])
    world = SmoothWorld(first, np.zeros((2, 2)), lambda x: pull @ x, lambda x: pull > 0, dt)
    for _ in range(40):
        world.step(np.zeros((2, 2)))
    swing = 0.5 * np.cos(np.sqrt(2.0 * SPRING_STIFFNESS) * 40 * dt)
    np.testing.assert_allclose(world.position[:, 0], [-swing, swing], atol=1e-9)


def test_pullers_go_straight_on_and_followers_are_pulled_within_the_radius_alone():
    run = run_episode(AttractionTask(), RestPolicy(), 0)
    pulls = np.array([kind == "puller" for kind in run.scene.node_type])
    straight = run.velocity[:, pulls] - run.velocity[:1, pulls]
    np.testing.assert_allclose(straight, 0.0, atol=1e-12)
    apart = np.linalg.norm(run.position[:, :, None] - run.position[:, None], axis=-1)
    pairs = pulls[:, None] != pulls[None, :]
    assert np.array_equal(run.contact, pairs & (apart < ATTRACTION_RADIUS))
    # A step in which no follower is near a puller, and one in which some is.
    change = np.linalg.norm(np.diff(run.velocity, axis=0), axis=-1)
    near = (run.contact[:-1] | run.contact[1:]).any(axis=2)
    assert change[~near & ~pulls].max() < 1e-10
    assert change[near & ~pulls].max() > 1e-3


def test_the_pull_falls_linearly_to_the_radius():
    task = AttractionTask(2)
    task.reset(seed=0)
    acceleration = task.world._acceleration
    for distance in (0.05, 0.3, 0.59, 0.61):
        pulled = acceleration(np.array([[0.0, 0.0], [distance, 0.0]]))
        size = ATTRACTION * max(1.0 - distance / ATTRACTION_RADIUS, 0.0)
        soft = distance / np.hypot(distance, SOFTENING)
        np.testing.assert_allclose(pulled, [[0.0, 0.0], [-size * soft, 0.0]], atol=1e-12)


@pytest.mark.parametrize("task", [SpringsTask, AttractionTask])
@pytest.mark.parametrize("bodies", [1, 21])
def test_a_wrong_number_of_bodies_is_one_line(task, bodies):
    with pytest.raises(InvalidInputError, match="objects must be 2 to 20, found"):
        task(bodies)
