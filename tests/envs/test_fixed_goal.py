"""Episodes with shared targets and goal and varying start positions."""

from functools import partial

import numpy as np
import pytest

from contactgraph.envs import DoorExpert, DoorTask, MultiPickupTask, PickupExpert, PickupTask
from contactgraph.envs.episodes import collect, episode_seeds, fixed_seed
from contactgraph_franka.envs.franka_task import FrankaTask

SEEDS = range(20)
TARGETS = {PickupTask: 1, partial(MultiPickupTask, 3): 3, DoorTask: 1, FrankaTask: 1}
"""Number of targets, the nodes after the gripper."""
EXPERTS = {PickupTask: PickupExpert, MultiPickupTask: PickupExpert, DoorTask: DoorExpert}


def begun(task, seed):
    """A scene, and positions ``[N, 2 or 3]`` m at its beginning."""
    observation, _ = task.reset(seed=seed)
    return task.scene, observation["position"]


@pytest.fixture(params=TARGETS, ids=["pickup", "multi-pickup", "door", "franka"])
def task_class(request):
    return request.param


def test_targets_and_goal_are_shared_and_all_else_is_not(task_class):
    scenes = [begun(task_class(distractors=2, fixed_seed=7), seed) for seed in SEEDS]
    free = 1 + TARGETS[task_class]
    (first_scene, first), *others = scenes
    for scene, position in others:
        assert np.array_equal(scene.goal, first_scene.goal)
        assert np.array_equal(position[1:free], first[1:free])
        if scene.hinged.any():
            assert np.array_equal(scene.anchor[1:free], first_scene.anchor[1:free])
            for name in ("angle", "goal_angle"):
                assert scene.metadata[name] == first_scene.metadata[name]
    for node in (0, free, free + 1):
        places = np.stack([position[node] for _, position in scenes])
        assert len(np.unique(places, axis=0)) == len(SEEDS)
        assert np.ptp(places[:, :2], axis=0).min() > 0.2


def test_another_fixed_seed_gives_another_goal_and_other_targets(task_class):
    goals, targets = [], []
    for fixed in SEEDS:
        scene, position = begun(task_class(fixed_seed=fixed), 0)
        goals.append(scene.goal)
        targets.append(position[1])
    assert len(np.unique(goals, axis=0)) == len(np.unique(targets, axis=0)) == len(SEEDS)


def test_how_many_distractors_there_are_does_not_move_them(task_class):
    free = 1 + TARGETS[task_class]
    most = 5 if task_class is FrankaTask else 10
    for fixed in SEEDS:
        alone, position = begun(task_class(fixed_seed=fixed), 0)
        among, beside = begun(task_class(distractors=most, fixed_seed=fixed), 1)
        assert np.array_equal(alone.goal, among.goal)
        assert np.array_equal(position[1:free], beside[1:free])


@pytest.mark.parametrize("task", [PickupTask, DoorTask])
def test_gripper_target_and_goal_of_a_seed_do_not_depend_on_the_distractors(task):
    for seed in SEEDS:
        alone, position = begun(task(0), seed)
        among, beside = begun(task(10), seed)
        assert np.array_equal(position, beside[:2])
        assert np.array_equal(alone.goal, among.goal)


def test_metadata_reproduces_a_scene(task_class):
    metadata = begun(task_class(distractors=1, fixed_seed=7), 5)[0].metadata
    assert (metadata["seed"], metadata["fixed_seed"]) == (5, 7)
    assert "fixed_seed" not in begun(task_class(), 5)[0].metadata


def test_shared_and_free_parts_use_separate_streams():
    shared = [fixed_seed(seed) for seed in range(100)]
    assert len(set(shared)) == 100
    drawn = [episode_seeds(100, seed) for seed in range(100)]
    assert len(set().union(*drawn)) == 100 * 100, "of other episodes and datasets"
    for seed in range(100):
        assert not {shared[seed], seed} & set(drawn[seed])


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("task", EXPERTS)
def test_experts_without_noise_succeed_and_give_the_same_force_in_the_same_state(task, seed):
    expert = EXPERTS[task](noise=0.0)
    trajectories = collect([partial(task, fixed_seed=fixed_seed(seed))], [expert], 20, seed)
    assert sum(bool(trajectory.scene.metadata["success"]) for trajectory in trajectories) >= 19
    trajectory = trajectories[0]
    expert.reset(trajectory.scene, seed=1234)
    for step in (0, 10, 30, 60):
        now = {
            name: getattr(trajectory, name)[step] for name in ("position", "velocity", "contact")
        }
        force = np.clip(expert({**now, "goal": trajectory.scene.goal}), -10.0, 10.0)
        np.testing.assert_array_equal(force, trajectory.control[step])
