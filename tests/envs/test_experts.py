from functools import partial

import numpy as np
import pytest

from contactgraph.data import Scene
from contactgraph.envs import (
    DoorTask,
    ExplorationPolicy,
    PickupExpert,
    PickupTask,
    RestPolicy,
    SuctionTask,
)
from contactgraph.envs.exploration import CorrelatedNoise
from contactgraph.evaluate import collect, run_episode

START_UP = 4
"""Steps a gripper at rest is given to gain speed."""


@pytest.fixture(scope="module")
def expert_runs(engine):
    return collect([lambda: PickupTask(10)], [PickupExpert()], 40, 0)


def first_contact(run):
    assert run.contact[:, 0, 1].any(), "the expert must reach its target"
    return int(run.contact[:, 0, 1].argmax())


def test_the_expert_succeeds_without_missing_the_target_or_touching_another(expert_runs):
    assert sum(run.scene.metadata["success"] for run in expert_runs) >= 39
    assert max(first_contact(run) for run in expert_runs) < 25
    for run in expert_runs:
        assert run.contact.sum() == 2 * run.contact[:, 0, 1].sum()


def test_the_expert_never_stops_before_the_target(expert_runs):
    at_contact = []
    for run in expert_runs:
        speed = np.linalg.norm(run.velocity[:, 0], axis=-1)[: first_contact(run)]
        assert speed[START_UP:].min() > 0.1
        at_contact.append(speed[-1])
    assert np.median(at_contact) >= 0.3


def test_the_force_is_not_a_function_of_the_state():
    still = collect([PickupTask], [PickupExpert(noise=0.0)], 2, 0)
    again = collect([PickupTask], [PickupExpert(noise=0.0)], 2, 0)
    noisy = collect([PickupTask], [PickupExpert()], 2, 0)
    for one, same, other in zip(still, again, noisy, strict=True):
        assert np.array_equal(one.control, same.control)
        difference = (other.control - one.control)[:3]
        assert 0.05 < np.abs(difference).mean() < 1.5


def test_a_grasped_pair_has_one_velocity_and_one_distance(expert_runs):
    """At the latest one step after the touch: a joint made in its last substep acts in the next."""
    late = 0
    for run in expert_runs:
        first = first_contact(run)
        apart = np.abs(run.velocity[first:, 0] - run.velocity[first:, 1]).max(axis=-1)
        late += apart[0] > 1e-3
        assert apart[1:].max() < 1e-6
        offset = (run.position[:, 1] - run.position[:, 0])[first + 1 :]
        # Box2D leaves an overlap of up to 0.5 mm.
        np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), 0.08, atol=5e-4)
        np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=5e-6)
    assert late <= 8


@pytest.mark.usefixtures("engine")
def test_exploration_moves_about_hits_something_and_stays_near():
    runs = collect([lambda: PickupTask(3)], [ExplorationPolicy()], 20, 0)
    touched = [run.contact.any() for run in runs]
    assert 3 <= sum(touched) <= 19
    for run in runs:
        assert np.ptp(run.position[:, 0], axis=0).min() > 0.2
        assert np.abs(run.position).max() < 3.0


def test_exploration_is_drawn_to_the_middle_of_the_scene_wherever_that_is():
    scene = Scene(("hand", "block"), ("hand", "block"), np.array([True, False]), 0.01, 3)
    explore = ExplorationPolicy(deviation=0.0, stiffness=2.0, damping=0.5)
    place, speed = np.array([[5.0, 1.0, 2.0], [4.0, 3.0, 0.0]]), np.array([[0.0, 0.0, 4.0]] * 2)
    first = {"position": place, "velocity": speed, "goal": np.array([4.0, 1.0, 8.0])}
    explore.reset(scene, 0)
    np.testing.assert_allclose(explore(first), 2.0 * np.array([-0.5, 1.0, 2.0]) - [0.0, 0.0, 2.0])
    later = {**first, "position": place + 1.0}
    np.testing.assert_allclose(explore(later), explore(first) - 2.0)
    explore.reset(scene, 0)
    np.testing.assert_allclose(explore(later)[:2], [-2.0, 1.0])  # to a new middle


@pytest.mark.parametrize(
    ("task", "steps"), [(partial(PickupTask, 3), 200), (DoorTask, 120), (SuctionTask, 240)]
)
def test_rest_rests_and_is_no_success(task, steps):
    run = run_episode(task(), RestPolicy(), 0)
    assert run.steps == steps and run.scene.metadata["success"] is False
    assert not run.control.any() and not run.velocity.any() and not run.contact.any()
    assert np.array_equal(run.position[0], run.position[-1])


def test_noise_has_the_configured_deviation_and_correlation():
    noise = CorrelatedNoise(deviation=0.5, correlation_steps=2.0)
    noise.reset(4000, seed=0)
    values = np.stack([noise() for _ in range(5)])
    np.testing.assert_allclose(values.std(axis=1), 0.5, rtol=0.05)
    correlation = np.mean(values[0] * values[2]) / 0.25
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.05)
