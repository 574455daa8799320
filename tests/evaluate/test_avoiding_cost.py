"""The costs that keep a task's bodies clear of all others."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import MultiPickupTask
from contactgraph.policies import TaskCost, avoid_others


def task_of(distractors: int) -> MultiPickupTask:
    task = MultiPickupTask(2, distractors)
    task.reset(seed=0)
    return task


def test_all_bodies_of_the_task_avoid_all_others_by_their_radii_and_the_clearance() -> None:
    scene = task_of(3).scene
    touched, found = avoid_others(scene, (0, 1, 2), 0.05, 300.0)
    for each in (touched, found):
        pairs = {tuple(pair) for pair in np.asarray(each.pairs).tolist()}
        assert pairs == {(one, other) for one in (0, 1, 2) for other in (3, 4, 5)}
    np.testing.assert_allclose(found.distance, 2 * scene.radius[0] + 0.05, rtol=1e-6)
    np.testing.assert_allclose(found.weight, 300.0)
    assert found.dimension == 2
    assert not len(touched.wanted_nodes)
    assert len(avoid_others(replace(scene, radius=None), (0, 1, 2), 0.0)) == 1


def test_the_cost_follows_its_nodes_and_the_goal() -> None:
    task = task_of(3)
    cost = TaskCost(task.cost_terms(), 2, task.cost_terms).in_scene(task.scene)
    assert cost.order == (0, 1, 2) and cost.among((0, 2, 1)).order == (0, 2, 1)
    observation, _ = task.reset(seed=0)
    assert cost.seeing(observation) is cost
    moved = {**observation, "goal": np.array([0.1, 0.2])}
    np.testing.assert_allclose(cost.seeing(moved).goal, [0.1, 0.2])


def test_without_others_there_is_nothing_to_avoid() -> None:
    assert avoid_others(task_of(0).scene, (0, 1, 2), 0.05) == ()
    scene = task_of(1).scene
    with pytest.raises(InvalidInputError, match="a clearance from bodies needs their radius"):
        avoid_others(replace(scene, radius=None), (0, 1, 2), 0.05)
