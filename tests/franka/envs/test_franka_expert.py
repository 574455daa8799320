"""The arm's expert, and the invariants of every control step of its sweeps."""

import numpy as np
import pytest
from franka_runs import HIGH, LOW, TORQUE, WatchedTask

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.episodes import episode_seeds, run_episode
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.franka_task import FrankaTask

RUNS = 20


@pytest.fixture(scope="module")
def sweeps():
    """(task, trajectory, recorded internals), with 0 and 5 distractors in turn."""
    done = []
    for index, seed in enumerate(episode_seeds(RUNS, 0)):
        task = WatchedTask(5 * (index % 2))
        run = run_episode(task, FrankaExpert(), seed)
        done.append((task, run, task.watched))
    return done


def grasped(run):
    assert run.contact[:, 0, 1].any(), "the expert must grasp its block"
    return int(run.contact[:, 0, 1].argmax())


@pytest.mark.slow
def test_the_expert_succeeds(sweeps):
    assert sum(task.success() for task, _, _ in sweeps) >= 0.95 * RUNS


@pytest.mark.slow
def test_the_expert_grasps_at_speed_and_never_stops_before(sweeps):
    at_grasp = []
    for _, run, _ in sweeps:
        speed = np.linalg.norm(run.velocity[:, 0], axis=-1)
        at_grasp.append(speed[grasped(run)])
        # Once under way.
        assert speed[int(np.argmax(speed > 0.15)) : grasped(run) + 10].min() > 0.12
    assert np.median(at_grasp) >= 0.3 and min(at_grasp) >= 0.2


@pytest.mark.slow
def test_a_grasped_block_leaves_the_table_at_once_and_moves_with_the_hand(sweeps):
    for _, run, _ in sweeps:
        at = grasped(run)
        assert run.velocity[at, 0, 2] > 0.02
        assert run.position[at + 20, 1, 2] > 0.055
        held = slice(at + 15, None)
        assert run.contact[held, 0, 1].all()
        apart = (run.position[:, 1] - run.position[:, 0])[held]
        assert np.abs(apart - apart[0]).max() < 6e-3
        assert run.position[-1, 1, 2] > 0.1


@pytest.mark.slow
def test_the_expert_touches_nothing_but_its_block(sweeps):
    for _, run, _ in sweeps:
        assert run.contact.sum() == 2 * run.contact[:, 0, 1].sum()
        np.testing.assert_allclose(run.position[-1, 2:], run.position[0, 2:], atol=2e-4)


@pytest.mark.slow
def test_the_arm_keeps_its_limits_at_every_step_of_a_sweep_and_ends_at_rest(sweeps):
    for task, run, watched in sweeps:
        torque, joints = np.array(watched.torque), np.array(watched.joints)
        assert len(torque) == 4000
        assert np.all(np.abs(torque) <= TORQUE + 1e-9)
        # A soft end stop gives way a little.
        assert np.all((joints >= LOW - 5e-3) & (joints <= HIGH + 5e-3))
        assert max(watched.turn_angle) < 0.5
        assert not task.world.brakes.closed
        assert np.linalg.norm(run.velocity[-1, :2], axis=-1).max() < 0.05
    control = np.stack([run.control for _, run, _ in sweeps])
    assert np.abs(control).max() <= 20.0
    assert (np.abs(control) == 20.0).mean() < 0.01


def first_controls(expert):
    task = FrankaTask()
    observation, _ = task.reset(seed=3)
    expert.reset(task.scene, 3)
    controls = []
    for _ in range(20):
        controls.append(expert(observation))
        observation, *_ = task.step(controls[-1])
    return np.array(controls)


def test_the_force_is_not_a_function_of_the_state():
    still, again, noisy = (first_controls(FrankaExpert(noise=noise)) for noise in (0.0, 0.0, 0.2))
    assert np.array_equal(still, again)
    assert 0.02 < np.abs(noisy - still).mean() < 1.0


def test_the_expert_refuses_a_scene_that_is_no_such_pickup():
    scene = Scene(("hand",), ("hand",), np.array([True]), 0.01, dimension=3)
    with pytest.raises(InvalidInputError, match="the arm's expert needs a goal, three dimensions"):
        FrankaExpert().reset(scene, 0)
