import gymnasium
import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import PickupTask, RestPolicy
from contactgraph.envs.pickup_layout import (
    CORRIDOR,
    OVERSHOOT,
    RADIUS,
    distance_to_paths,
)
from contactgraph.evaluate import run_episode

pytestmark = pytest.mark.usefixtures("engine")

SEEDS = range(40)


def run(seed, distractors=3, steps=200):
    task = PickupTask(distractors)
    rng = np.random.default_rng(seed)
    observations = [task.reset(seed=seed)[0]]
    for _ in range(steps):
        observations.append(task.step(rng.uniform(-10.0, 10.0, 2))[0])
    return observations


def test_a_seed_gives_the_same_episode_to_the_last_bit():
    for one, other in zip(run(7), run(7), strict=True):
        for name in one:
            assert one[name].dtype == other[name].dtype
            assert np.array_equal(one[name], other[name])
    assert not np.array_equal(run(7, steps=0)[0]["position"], run(8, steps=0)[0]["position"])


def test_the_reported_seed_reproduces_an_unseeded_episode():
    task = PickupTask(2)
    task.reset(seed=3)
    first, _ = task.reset()
    second, _ = task.reset()
    assert not np.array_equal(first["position"], second["position"])
    again, _ = PickupTask(2).reset(seed=task.scene.metadata["seed"])
    assert np.array_equal(again["position"], second["position"])


@pytest.mark.parametrize("distractors", [0, 3, 20])
def test_everything_begins_apart_and_at_rest(distractors):
    for seed in SEEDS:
        task = PickupTask(distractors)
        observation, _ = task.reset(seed=seed)
        position, goal = observation["position"], observation["goal"]
        assert position.shape == (2 + distractors, 2)
        assert np.all(np.abs(position) <= 1.0 - RADIUS) and np.all(np.abs(goal) <= 1.0)
        assert not observation["velocity"].any() and not observation["contact"].any()
        distance = np.linalg.norm(position[:, None] - position, axis=-1)
        assert distance[np.triu_indices(len(position), 1)].min() >= 2 * RADIUS + 0.06 - 1e-6
        assert distance[0, 1] >= 0.3 - 1e-6
        assert np.linalg.norm(position[1] - goal) >= 0.3 - 1e-6


@pytest.mark.parametrize("distractors", [3, 20])
def test_no_distractor_lies_near_the_paths(distractors):
    for seed in SEEDS:
        observation, _ = PickupTask(distractors).reset(seed=seed)
        position, goal = observation["position"], observation["goal"]
        for start, end in [(position[0], position[1]), (position[1], goal)]:
            length = np.linalg.norm(end - start)
            along = np.linspace(0.0, length + OVERSHOOT, 400)[:, None]
            way = start + along * (end - start) / length
            distance = np.linalg.norm(position[2:, None] - way, axis=-1)
            assert distance.min() >= CORRIDOR - 1e-6


def test_distance_to_paths_by_hand():
    stops = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert distance_to_paths(np.array([0.5, -0.4]), stops) == pytest.approx(0.4)
    assert distance_to_paths(np.array([-0.3, 0.4]), stops) == pytest.approx(0.5)
    assert distance_to_paths(np.array([1.0 + OVERSHOOT, 0.1]), stops) == pytest.approx(0.1)
    assert distance_to_paths(np.array([0.8, 0.9]), stops) == pytest.approx(0.2)


def test_the_target_and_goal_of_a_seed_do_not_depend_on_the_distractors():
    for seed in SEEDS:
        with_none, _ = PickupTask(0).reset(seed=seed)
        with_ten, _ = PickupTask(10).reset(seed=seed)
        assert np.array_equal(with_none["position"], with_ten["position"][:2])
        assert np.array_equal(with_none["goal"], with_ten["goal"])


def test_the_scene_describes_its_nodes(engine):
    task = PickupTask(2)
    observation, _ = task.reset(seed=5)
    scene = task.scene
    assert scene.node_name == ("gripper", "target", "distractor-0", "distractor-1")
    assert scene.node_type == ("gripper", "object", "object", "object")
    assert scene.actuated.tolist() == [True, False, False, False]
    assert scene.dt == 0.05 and scene.mass.tolist() == [1.0] * 4
    assert scene.radius.tolist() == [0.04] * 4
    assert np.array_equal(scene.goal, observation["goal"])
    assert scene.metadata["task"] == "pickup" and scene.metadata["seed"] == 5
    assert scene.metadata["distractors"] == 2 and scene.metadata["substeps"] == 10
    assert scene.metadata["simulator"].startswith(f"{engine} ")


def test_the_control_is_clipped_and_must_be_finite():
    hard, bounded = PickupTask(), PickupTask()
    hard.reset(seed=0)
    bounded.reset(seed=0)
    one, *_ = hard.step(np.array([1e9, -30.0]))
    other, *_ = bounded.step(np.array([10.0, -10.0]))
    assert np.array_equal(one["position"], other["position"])
    assert other["velocity"][0] == pytest.approx([0.5, -0.5], abs=1e-5)
    with pytest.raises(InvalidInputError, match=r"action must be finite, found .*nan"):
        hard.step(np.array([np.nan, 0.0]))


def test_an_episode_takes_200_steps():
    task = PickupTask()
    with pytest.raises(gymnasium.error.ResetNeeded):
        task.step(np.zeros(2))
    task.reset(seed=0)
    for step in range(1, 201):
        *_, terminated, truncated, _ = task.step(np.zeros(2))
        assert not terminated and truncated == (step == 200)
    with pytest.raises(gymnasium.error.ResetNeeded):
        task.step(np.zeros(2))


def test_success_is_the_target_at_the_goal_in_the_end():
    task = PickupTask()
    observation, _ = task.reset(seed=0)
    assert not run_episode(PickupTask(), RestPolicy(), 0).scene.metadata["success"]

    def solved(target):
        position = observation["position"].copy()
        position[1] = target
        return task.solved(task.scene, position, observation["contact"])

    goal = task.scene.goal
    assert solved(goal + np.array([0.0, 0.0999])) and not task.success(), "it is not over"
    assert not solved(goal + np.array([0.0, 0.1001]))


def test_the_cost_has_the_weights_of_the_paper():
    cost = PickupTask(4).cost_terms()
    assert cost.chain == (0, 1)
    assert cost.pick_weights.tolist() == [3.0, 3.0, 0.2, 0.2]
    assert cost.goal_weights.tolist() == [50.0, 50.0, 1.0, 1.0]
    assert cost.control_weight == 0.01


@pytest.mark.parametrize("distractors", [-1, 21])
def test_distractors_out_of_range(distractors):
    with pytest.raises(
        InvalidInputError, match=f"distractors must be 0 to 20, found {distractors}"
    ):
        PickupTask(distractors)
