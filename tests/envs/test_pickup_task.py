"""Pickups of one object and of several: layouts, the course of an episode, success."""

import gymnasium
import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import DoorTask, MultiPickupTask, PickupExpert, PickupTask
from contactgraph.envs.gripper_task import fixed_layout
from contactgraph.envs.pickup import held
from contactgraph.envs.pickup_layout import (
    CLEARANCE,
    CORRIDOR,
    IN_THE_WAY,
    OVERSHOOT,
    RADIUS,
    STANDING_ROOM,
    TARGET_CORRIDOR,
    distance_to_path,
    extent,
    sample_layout,
)
from contactgraph.evaluate import collect

SEEDS = range(30)


def test_the_reported_seed_reproduces_an_unseeded_episode():
    task = PickupTask(2)
    task.reset(seed=3)
    first, _ = task.reset()
    second, _ = task.reset()
    assert not np.array_equal(first["position"], second["position"])
    again, _ = PickupTask(2).reset(seed=task.scene.metadata["seed"])
    assert np.array_equal(again["position"], second["position"])


def test_one_object_is_laid_out_as_a_pickup():
    for seed in range(5):
        multi, _ = MultiPickupTask(1, 4).reset(seed=seed)
        single, _ = PickupTask(4).reset(seed=seed)
        assert np.array_equal(multi["position"], single["position"])
        assert np.array_equal(multi["goal"], single["goal"])
        assert not single["velocity"].any() and not single["contact"].any()


def nearest(nodes):
    """The least distance of two nodes ``[N, 2]`` m."""
    distance = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
    return distance[np.triu_indices(len(nodes), 1)].min(initial=np.inf)


@pytest.mark.parametrize("fixed_seed", [None, 3])
@pytest.mark.parametrize(("objects", "distractors"), [(1, 0), (1, 20), (2, 3), (5, 10)])
def test_stops_are_apart_and_the_paths_are_clear(objects, distractors, fixed_seed):
    fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, objects, 20))
    for seed in SEEDS:
        layout = sample_layout(np.random.default_rng(seed), objects, distractors, fixed)
        assert layout.position.shape == (1 + objects + distractors, 2)
        assert np.abs(layout.stops).max() <= 1.0 - RADIUS
        assert np.abs(layout.position).max() <= extent(objects) - RADIUS
        assert nearest(layout.position) >= 2 * RADIUS + CLEARANCE - 1e-6
        for index in range(objects + 1):
            start, end = layout.stops[index : index + 2]
            length = np.linalg.norm(end - start)
            assert length >= 0.3
            along = np.linspace(0.0, length + OVERSHOOT, 200)[:, None]
            way = start + along * (end - start) / length
            for node, clearance in [
                *((other, CORRIDOR) for other in layout.distractors),
                *((due, TARGET_CORRIDOR) for due in layout.stops[index + 2 : -1]),
            ]:
                assert np.linalg.norm(node - way, axis=-1).min() >= clearance - 1e-6


def test_distractors_in_the_way_stand_on_the_straight_ways_but_at_no_stop():
    for seed in SEEDS:
        layout = sample_layout(np.random.default_rng(seed), 1, 10, in_the_way=True)
        ways = list(zip(layout.stops, layout.stops[1:], strict=False))
        touched = [
            min(distance_to_path(each, *way, 0.0) for way in ways) < 2 * RADIUS
            for each in layout.distractors
        ]
        assert len(touched) == 10 and sum(touched) >= IN_THE_WAY
        gaps = np.linalg.norm(layout.distractors[:, None] - layout.stops, axis=-1)
        assert gaps.min() >= STANDING_ROOM
        assert nearest(layout.distractors) >= 2 * RADIUS + CLEARANCE


def test_the_scene_describes_its_nodes(engine):
    task = MultiPickupTask(2, 1)
    observation, _ = task.reset(seed=5)
    scene, metadata = task.scene, task.scene.metadata
    assert scene.node_name == ("gripper", "target-1", "target-2", "distractor-0")
    assert scene.node_type == ("gripper", "object", "object", "object")
    assert scene.actuated.tolist() == [True, False, False, False]
    assert scene.dt == 0.05 and scene.mass.tolist() == [1.0] * 4
    assert scene.radius.tolist() == [0.04] * 4
    assert np.array_equal(scene.goal, observation["goal"])
    assert (metadata["task"], metadata["seed"], metadata["objects"]) == ("multi-pickup", 5, 2)
    assert (metadata["distractors"], metadata["substeps"]) == (1, 10)
    assert metadata["simulator"].startswith(f"{engine} ")


def test_an_episode_takes_200_steps_of_finite_controls():
    task = PickupTask()
    with pytest.raises(gymnasium.error.ResetNeeded):
        task.step(np.zeros(2))
    task.reset(seed=0)
    for step in range(1, 201):
        *_, terminated, truncated, _ = task.step(np.zeros(2))
        assert not terminated and truncated == (step == 200)
    with pytest.raises(gymnasium.error.ResetNeeded):
        task.step(np.zeros(2))
    task.reset(seed=0)
    with pytest.raises(InvalidInputError, match=r"action must be finite, found .*nan"):
        task.step(np.array([np.nan, 0.0]))


def test_attached_includes_indirectly_grasped_nodes():
    contact = np.zeros((6, 6), dtype=np.int8)
    for one, other in [(0, 3), (3, 1), (2, 4)]:
        contact[one, other] = contact[other, one] = 1
    assert held(contact) == {1, 3}
    assert held(np.zeros((3, 3))) == set()


def test_success_is_all_grasped_and_the_last_at_the_goal_in_the_end():
    pickup, task = PickupTask(), MultiPickupTask(2)
    pickup.reset(seed=0)
    task.reset(seed=0)
    goal = task.scene.goal
    position = np.array([goal, goal, goal + np.array([0.0999, 0.0])])
    chain = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=bool)
    assert task.solved(task.scene, position, chain) and not task.success(), "it is not over"
    assert not task.solved(task.scene, position + 0.001, chain)
    chain[1, 2] = chain[2, 1] = False
    assert not task.solved(task.scene, position, chain)
    for away, solved in [(0.0999, True), (0.1001, False)]:
        position = pickup.scene.goal + np.array([[0.0, 0.0], [0.0, away]])
        assert pickup.solved(pickup.scene, position, np.zeros((2, 2))) is solved


@pytest.mark.parametrize(
    ("task", "chain", "pick_weights"),
    [
        (PickupTask(4), (0, 1), [3.0, 3.0, 0.2, 0.2]),
        (MultiPickupTask(3, 2), (0, 1, 2, 3), [3.0, 3.0, 0.2, 0.2]),
        (DoorTask(4), (0, 1), [6.5, 6.5, 0.2, 0.2]),
    ],
)
def test_the_cost_has_the_weights_of_the_paper(task, chain, pick_weights):
    cost = task.cost_terms()
    assert (cost.chain, cost.pick_weights.tolist()) == (chain, pick_weights)
    assert cost.goal_weights.tolist() == [50.0, 50.0, 1.0, 1.0]
    assert cost.control_weight == 0.01


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(("objects", "distractors"), [(2, 3), (5, 0)])
def test_the_expert_picks_up_all_and_takes_them_to_the_goal(objects, distractors):
    runs = collect([lambda: MultiPickupTask(objects, distractors)], [PickupExpert()], 20, 0)
    assert sum(run.scene.metadata["success"] for run in runs) >= 19
    in_order = 0
    for run in runs:
        joined = [held(contact) for contact in run.contact]
        first = [next(t for t, each in enumerate(joined) if n in each) for n in (1, objects)]
        in_order += first[0] < first[1]
        momentum = run.velocity.sum(axis=1)
        np.testing.assert_allclose(np.diff(momentum, axis=0), 0.05 * run.control, atol=1e-5)
    assert in_order >= 19
