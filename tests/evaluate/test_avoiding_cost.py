"""The cost that keeps a task's bodies clear of all others."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import MultiPickupTask
from contactgraph.policies import AvoidingCost, TaskCost


def in_scene(distractors: int) -> tuple[AvoidingCost, MultiPickupTask]:
    task = MultiPickupTask(2, distractors)
    task.reset(seed=0)
    own = TaskCost.of(task.cost_terms(), 2, task.cost_terms)
    return AvoidingCost(own, 0.05, 300.0).in_scene(task.scene), task


def test_all_bodies_of_the_task_avoid_all_others_by_their_radii_and_the_clearance() -> None:
    cost, task = in_scene(3)
    touched, found = cost.quadratic(8).contacts
    for each in (touched, found):
        pairs = {tuple(pair) for pair in np.asarray(each.pairs).tolist()}
        assert pairs == {(one, other) for one in (0, 1, 2) for other in (3, 4, 5)}
    np.testing.assert_allclose(found.distance, 2 * task.scene.radius[0] + 0.05, rtol=1e-6)
    np.testing.assert_allclose(found.weight, 300.0)
    assert found.dimension == 2
    assert not len(touched.wanted_nodes)
    without = replace(cost, clearance=0.0).in_scene(replace(task.scene, radius=None))
    assert len(without.quadratic(8).contacts) == 1


def test_the_other_cost_stays_as_it_is() -> None:
    cost, task = in_scene(3)
    own = cost.cost
    assert cost.order == own.order == (0, 1, 2)
    for changed in (cost, cost.among((0, 2, 1))):
        plain = changed.cost.quadratic(6)
        np.testing.assert_array_equal(changed.quadratic(6).Q, plain.Q)
        assert len(changed.quadratic(6).contacts) == 2
    assert cost.among((0, 2, 1)).order == (0, 2, 1)
    observation, _ = task.reset(seed=0)
    assert cost.seeing(observation) is cost
    moved = {**observation, "goal": np.array([0.1, 0.2])}
    np.testing.assert_allclose(cost.seeing(moved).cost.goal, [0.1, 0.2])


def test_without_others_there_is_nothing_to_avoid() -> None:
    cost, task = in_scene(0)
    assert cost.quadratic(3).contacts == ()
    among, task = in_scene(1)
    with pytest.raises(InvalidInputError, match="a clearance from bodies needs their radius"):
        among.in_scene(replace(task.scene, radius=None))
