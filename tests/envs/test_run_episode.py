import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import ExplorationPolicy, PickupExpert, PickupTask, RestPolicy
from contactgraph.evaluate import collect, run_episode

pytestmark = pytest.mark.usefixtures("engine")


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
        self.count = 0
        observation, info = super().reset(**arguments)
        return self.turned(observation), info

    def step(self, action):
        self.count += 1
        observation, *rest = super().step(action)
        return self.turned(observation), *rest

    def turned(self, observation):
        angle = np.array([[1.0], [10.0]]) * self.count
        turned = {"holding": observation["contact"], "orientation": angle}
        return {**observation, **turned, "angular_velocity": -angle}


def test_what_a_task_observes_of_holding_and_turning_is_recorded():
    trajectory = run_episode(TurningTask(), PickupExpert(), 4)
    assert trajectory.holding.dtype == bool
    assert np.array_equal(trajectory.holding, trajectory.contact)
    assert np.array_equal(trajectory.orientation[:, 1, 0], 10.0 * np.arange(201))
    assert np.array_equal(trajectory.angular_velocity[:, 0, 0], -np.arange(201))


def test_a_task_that_does_not_observe_them_has_none_recorded():
    trajectory = run_episode(PickupTask(), PickupExpert(), 4)
    assert trajectory.holding is trajectory.orientation is trajectory.angular_velocity is None


def test_the_recorded_control_is_the_clipped_one():
    trajectory = run_episode(PickupTask(), Pusher(), 0)
    assert np.array_equal(np.unique(trajectory.control, axis=0), [[10.0, -3.0]])


def test_every_step_is_reported():
    observed = []
    trajectory = run_episode(
        PickupTask(),
        PickupExpert(),
        1,
        lambda step, observation, control: observed.append(
            (step, observation["position"], control)
        ),
    )
    assert [step for step, _, _ in observed] == list(range(200))
    assert np.array_equal(
        np.stack([position for _, position, _ in observed]), trajectory.position[:-1]
    )
    assert np.array_equal(np.stack([control for _, _, control in observed]), trajectory.control)


class Watched(PickupTask):
    """A pickup that shows a stick from above to its gripper, always in the same array."""

    stick = np.array([[0.0, 2.0], [0.0, 0.0]])

    def step(self, action):
        observation, *others = super().step(action)
        self.stick[1] = observation["position"][0]
        return observation, *others

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        self.stick[1] = observation["position"][0]
        return observation, info

    def link_positions(self):
        return self.stick


def test_a_task_that_is_drawn_has_its_links_recorded_at_every_state():
    trajectory = run_episode(Watched(), PickupExpert(), 4)
    assert trajectory.link_positions.shape == (201, 2, 2)
    assert np.array_equal(trajectory.link_positions[:, 1], trajectory.position[:, 0])
    assert np.array_equal(trajectory.link_positions[:, 0], np.tile([0.0, 2.0], (201, 1)))
    assert run_episode(PickupTask(), PickupExpert(), 4).link_positions is None


def test_metadata_names_the_policy_and_keeps_the_task():
    task = PickupTask()
    trajectory = run_episode(task, RestPolicy(), 9)
    assert (
        trajectory.scene.metadata["policy"] == "RestPolicy"
        and trajectory.scene.metadata["seed"] == 9
    )
    assert trajectory.scene.metadata["success"] is False
    assert run_episode(task, PickupExpert(), 9).scene.metadata["success"] is True
    assert "policy" not in task.scene.metadata


def test_a_trajectory_does_not_depend_on_their_number():
    few = collect([PickupTask], [PickupExpert()], 2, 3)
    many = collect([PickupTask], [PickupExpert()], 4, 3)
    assert all(same(one, other) for one, other in zip(few, many, strict=False))
    assert not same(many[0], many[1])


def test_the_seed_in_the_metadata_reproduces_the_trajectory():
    trajectory = collect([PickupTask], [PickupExpert()], 3, 5)[2]
    assert same(
        trajectory, run_episode(PickupTask(), PickupExpert(), trajectory.scene.metadata["seed"])
    )


def test_other_seeds_give_other_trajectories():
    assert not same(*(collect([PickupTask], [PickupExpert()], 1, seed)[0] for seed in (0, 1)))


def test_policies_take_turns_and_every_trajectory_is_reported():
    done = []
    mix = [PickupExpert(), PickupExpert(), ExplorationPolicy(), RestPolicy()]
    trajectories = collect([PickupTask], mix, 6, 0, done.append)
    assert [trajectory.scene.metadata["policy"] for trajectory in trajectories] == [
        "PickupExpert",
        "PickupExpert",
        "ExplorationPolicy",
        "RestPolicy",
        "PickupExpert",
        "PickupExpert",
    ]
    assert len(done) == 6 and all(
        one is other for one, other in zip(done, trajectories, strict=True)
    )


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
