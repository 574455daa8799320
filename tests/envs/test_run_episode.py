"""Recording of episodes, one after the other or by several processes."""

import os
from functools import partial

import numpy as np
import pytest

from contactgraph import parallel
from contactgraph.data import InvalidInputError
from contactgraph.envs import (
    DoorExpert,
    DoorTask,
    ExplorationPolicy,
    PickupExpert,
    PickupTask,
    RestPolicy,
)
from contactgraph.envs.episodes import Episode
from contactgraph.evaluate import collect, run_episode
from contactgraph.parallel import LocalExecutor


class Pusher:
    """Asks for more force than there is."""

    def reset(self, scene, seed):
        self.seed = seed

    def __call__(self, observation):
        return np.array([25.0, -3.0])


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("position", "velocity", "control", "contact")
    )


def test_states_controls_and_contacts_are_recorded_as_they_were():
    task = PickupTask(2)
    trajectory = run_episode(task, PickupExpert(), 4)
    assert trajectory.position.shape == trajectory.velocity.shape == (201, 4, 2)
    assert trajectory.control.shape == (200, 2) and trajectory.contact.shape == (201, 4, 4)
    replay, _ = task.reset(seed=4)
    for step, control in enumerate(trajectory.control):
        assert np.array_equal(trajectory.position[step], replay["position"])
        assert np.array_equal(trajectory.velocity[step], replay["velocity"])
        assert np.array_equal(trajectory.contact[step], replay["contact"].astype(bool))
        replay, *_ = task.step(control)
    assert np.array_equal(trajectory.position[-1], replay["position"])


class TurningTask(PickupTask):
    """A pickup that counts its steps in the observed turn, and whose pairs in contact hold."""

    def reset(self, **arguments):
        self.count = -1
        return super().reset(**arguments)

    def observed(self):
        self.count += 1
        observation, angle = super().observed(), np.array([[1.0], [10.0]]) * self.count
        turned = {"holding": observation["contact"], "orientation": angle}
        return {**observation, **turned, "angular_velocity": -angle}


def test_what_a_task_observes_of_holding_and_turning_is_recorded():
    trajectory = run_episode(TurningTask(), PickupExpert(), 4)
    assert trajectory.holding.dtype == bool
    assert np.array_equal(trajectory.holding, trajectory.contact)
    assert np.array_equal(trajectory.orientation[:, 1, 0], 10.0 * np.arange(201))
    assert np.array_equal(trajectory.angular_velocity[:, 0, 0], -np.arange(201))
    plain = run_episode(PickupTask(), PickupExpert(), 4)
    assert plain.holding is plain.link_positions is None
    assert np.isnan(plain.orientation).all() and np.isnan(plain.angular_velocity).all()


def test_the_recorded_control_is_the_clipped_one():
    trajectory = run_episode(PickupTask(), Pusher(), 0)
    assert np.array_equal(np.unique(trajectory.control, axis=0), [[10.0, -3.0]])


def test_an_episode_goes_on_step_by_step():
    episode, positions, controls = Episode(PickupTask(), PickupExpert(), 1), [], []
    while not episode.over:
        positions.append(episode.observation["position"])
        controls.append(episode.step())
    trajectory = run_episode(PickupTask(), PickupExpert(), 1)
    assert episode.steps == 200 and np.array_equal(np.stack(controls), trajectory.control)
    assert np.array_equal(np.stack(positions), trajectory.position[:-1])


class Watched(PickupTask):
    """A pickup that shows a stick from above to its gripper, always in the same array."""

    stick = np.array([[0.0, 2.0], [0.0, 0.0]])

    def link_positions(self):
        self.stick[1] = self.world.position[0]
        return self.stick


def test_a_task_that_is_drawn_has_its_links_recorded_at_every_state():
    trajectory = run_episode(Watched(), PickupExpert(), 4)
    assert trajectory.link_positions.shape == (201, 2, 2)
    assert np.array_equal(trajectory.link_positions[:, 1], trajectory.position[:, 0])
    assert np.array_equal(trajectory.link_positions[:, 0], np.tile([0.0, 2.0], (201, 1)))


def test_metadata_names_the_policy_and_keeps_the_task():
    task = PickupTask()
    trajectory = run_episode(task, RestPolicy(), 9)
    found = [trajectory.scene.metadata[name] for name in ("policy", "seed", "success")]
    assert found == ["RestPolicy", 9, False]
    assert run_episode(task, PickupExpert(), 9).scene.metadata["success"] is True
    assert "policy" not in task.scene.metadata


def test_a_trajectory_depends_on_its_seed_alone():
    few, many, others = (
        collect([PickupTask], [PickupExpert()], count, seed)
        for count, seed in [(2, 3), (4, 3), (1, 4)]
    )
    assert all(same(one, other) for one, other in zip(few, many, strict=False))
    assert not same(many[0], many[1]) and not same(many[0], others[0])
    again = run_episode(PickupTask(), PickupExpert(), many[3].scene.metadata["seed"])
    assert same(many[3], again)


def test_policies_take_turns_and_every_trajectory_is_reported():
    done = []
    mix = [PickupExpert(), PickupExpert(), ExplorationPolicy(), RestPolicy()]
    trajectories = collect([PickupTask], mix, 6, 0, done.append)
    found = [trajectory.scene.metadata["policy"] for trajectory in trajectories]
    assert found == [type(mix[index % 4]).__name__ for index in range(6)]
    assert all(one is other for one, other in zip(done, trajectories, strict=True))


def test_tasks_take_turns_and_each_trajectory_is_as_recorded_alone():
    factories = [lambda: PickupTask(0), lambda: PickupTask(2)]
    trajectories = collect(factories, [RestPolicy()], 3, 0)
    assert [trajectory.scene.node_count for trajectory in trajectories] == [2, 4, 2]
    alone = collect([lambda: PickupTask(2)], [RestPolicy()], 2, 0)
    assert same(trajectories[1], alone[1])


def test_arguments_out_of_range():
    policy = RestPolicy()
    with pytest.raises(InvalidInputError, match="task_factories must name at least one task"):
        collect([], [policy], 1, 0)
    with pytest.raises(InvalidInputError, match="episodes must be at least 1, found 0"):
        collect([PickupTask], [policy], 0, 0)
    with pytest.raises(InvalidInputError, match="seed must be at least 0, found -1"):
        collect([PickupTask], [policy], 1, -1)
    with pytest.raises(InvalidInputError, match="policies must name at least one policy"):
        collect([PickupTask], [], 1, 0)
    with pytest.raises(InvalidInputError, match="seed must be at least 0, found -2"):
        run_episode(PickupTask(), policy, -2)


def test_the_policy_has_a_seed_of_its_own():
    policy = Pusher()
    run_episode(PickupTask(), policy, 5)
    assert policy.seed != 5, "noise from the scene's numbers would depend on the layout"
    assert policy.seed == int(np.random.SeedSequence(5).generate_state(1)[0])


class Signed(PickupTask):
    """Records its process id."""

    def begin(self, seed):
        scene, world = super().begin(seed)
        scene.metadata["recorder"] = os.getpid()
        return scene, world


def test_several_processes_record_the_same_bits_as_one(monkeypatch):
    # Processes begin after the first run, whether they pay or not.
    monkeypatch.setattr(parallel, "_ALONE_S", 0.0)
    monkeypatch.setattr(parallel, "_START_S", 0.0)
    # Runs follow other runs than they would in one process: nothing may be left of those.
    tasks, reported = [Signed, partial(DoorTask, fixed_seed=7)], []
    mix = [PickupExpert(), DoorExpert(), ExplorationPolicy(), DoorExpert()]
    trajectories = collect(tasks, mix, 9, 3, reported.append, executor=LocalExecutor(2))
    alone = collect([PickupTask, tasks[1]], mix, 9, 3)
    assert all(same(one, other) for one, other in zip(trajectories, alone, strict=True))
    assert all(one is other for one, other in zip(reported, trajectories, strict=True))
    recorders = [trajectory.scene.metadata["recorder"] for trajectory in trajectories[::2]]
    assert recorders[0] == os.getpid() and os.getpid() not in recorders[1:]


def test_quick_episodes_start_no_workers(monkeypatch):
    def map_in_order(*arguments):
        raise AssertionError("it does not pay")

    monkeypatch.setattr(parallel, "map_in_order", map_in_order)
    assert len(collect([PickupTask], [PickupExpert()], 5, 0, executor=LocalExecutor(64))) == 5
