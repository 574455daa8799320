"""The hand's part of a step: forces on bodies, a moved goal, a switch."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import PickupTask, SuctionTask
from contactgraph.envs.contract import DisturbableTask
from contactgraph.evaluate import Episode
from contactgraph.play.stage import HandPolicy
from contactgraph_franka.envs.franka_task import FrankaTask


def test_a_disturbance_gives_its_impulse_once():
    task = PickupTask()
    begin, _ = task.reset(seed=0)
    force = np.array([[0.0, 0.0], [0.4, -0.2]])
    task.disturb(force)
    after, *_ = task.step(np.zeros(2))
    gained = after["velocity"] - begin["velocity"]
    assert gained == pytest.approx(force * task.scene.dt / task.scene.mass[:, None], abs=1e-6)
    later, *_ = task.step(np.zeros(2))
    assert later["velocity"] == pytest.approx(after["velocity"], abs=1e-6)


def test_a_disturbance_does_not_outlive_its_episode():
    task = PickupTask()
    task.reset(seed=0)
    task.disturb(np.ones((2, 2)))
    task.reset(seed=0)
    after, *_ = task.step(np.zeros(2))
    assert not after["velocity"].any()


def test_a_block_of_the_arms_table_is_lifted_by_more_than_its_weight():
    task = FrankaTask()
    begin, _ = task.reset(seed=0)
    mass, gravity = task.scene.mass[1], task.scene.gravity
    force = np.zeros((2, 3))
    force[1] = mass * (np.array([0.0, 0.0, 3.0]) - gravity)
    for _ in range(10):
        task.disturb(force)
        after, *_ = task.step(np.zeros(3))
    risen = after["position"][1] - begin["position"][1]
    elapsed = 10 * task.scene.dt
    assert risen[2] == pytest.approx(0.5 * 3.0 * elapsed**2, rel=0.15)
    assert not task.world.data.xfrc_applied.any(), "the next step has none"


def test_a_pushed_hand_moves_as_its_apparent_mass():
    task = FrankaTask()
    begin, _ = task.reset(seed=0)
    force = np.array([[8.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for _ in range(30):
        task.disturb(force)
        after, *_ = task.step(np.zeros(3))
    moved = after["velocity"][0] - begin["velocity"][0]
    # The observer that makes it so lags behind.
    assert moved[0] == pytest.approx(8.0 / 4.0 * 30 * task.scene.dt, rel=0.5)


def test_a_moved_goal_is_the_scenes():
    task = PickupTask()
    assert isinstance(task, DisturbableTask)
    task.reset(seed=0)
    task.move_goal([0.3, 0.1])
    after, *_ = task.step(np.zeros(2))
    assert after["goal"].tolist() == task.scene.goal.tolist() == [0.3, 0.1]


@pytest.mark.parametrize("goal", [[0.0], [0.0, np.nan], [0.0, 0.0, 0.0]])
def test_a_goal_that_is_no_place_is_refused(goal):
    task = PickupTask()
    task.reset(seed=0)
    with pytest.raises(InvalidInputError, match="goal must be finite"):
        task.move_goal(goal)


class Resting:
    """Stands in for a controller that rests with its switch on."""

    def reset(self, scene, seed):
        self.told = []

    def __call__(self, observation):
        return np.array([0.0, 0.0, 1.0])

    def applied(self, control):
        self.told.append(control.tolist())


def test_a_switch_by_hand_replaces_that_of_the_plan():
    task, controller = SuctionTask(), Resting()
    policy = HandPolicy(controller)
    policy.feedback = None
    episode = Episode(task, policy, 0)
    episode.step()
    assert task.world.switch == 1.0
    policy.switch = 0.0
    episode.step()
    assert task.world.switch == 0.0
    assert controller.told == [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], "the controller is told"
