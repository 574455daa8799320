"""Bodies of which any may be carried: which one a plan is about."""

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import ChainCost, StickyTask
from contactgraph.policies import CandidateTrials, TaskCost, avoid_others

DT = 0.05
WEIGHTS = np.ones(4)


def trials():
    return CandidateTrials(0, StickyTask().cost_terms().candidates)


def choose(of, steps=1, *, contact=(), holding=(), moving=(), goal=9.0):
    """The choice after some equal steps; bodies are 1, 2 and 3 m from the gripper."""
    velocity = np.zeros((4, 2))
    velocity[list(moving), 1] = 0.1
    held = np.isin(range(4), holding)
    observation = {"position": np.array([[0.0, 0], [3, 0], [1, 0], [2, 0]]), "velocity": velocity}
    observation["goal"] = np.array([goal, 0.0])
    for _ in range(steps):
        chosen = of.choose(observation, np.isin(range(4), contact) | held, held, DT)
    return chosen


def test_bodies_that_do_not_hold_are_given_up_in_the_order_of_their_distance():
    of = trials()
    assert choose(of) == 2, "the nearest first"
    assert choose(of, 9, contact=[2]) == 2
    assert choose(of, contact=[2]) == 3, "half a second of touching without a hold is enough"
    assert choose(of, 40) == 3, "what was tried is remembered"
    assert choose(of, 10, contact=[3]) == 1
    assert choose(of, 10, contact=[1]) == 1, "all were tried once, and it is at hand"
    assert choose(of, 10, contact=[1]) == 2, "until it is tried a second time"


def test_a_body_that_holds_and_moves_is_kept():
    of = trials()
    assert choose(of, 9, contact=[2]) == 2
    assert choose(of, contact=[2], holding=[1], moving=[1]) == 1, "whatever was to be tried"
    assert choose(of, 100, holding=[1], moving=[1]) == 1
    assert choose(of, 100, holding=[1], goal=3.05) == 1, "at rest at the goal"
    assert choose(of, 9, contact=[1]) == 1, "a hold that is lost"


def test_a_body_that_holds_and_does_not_move_is_given_up():
    of = trials()
    assert choose(of, 9, holding=[2]) == 2
    assert choose(of, holding=[2]) == 3
    assert choose(of, 20, holding=[2]) == 3, "although it still holds"


def test_metrics_are_about_the_candidate_nearest_the_goal():
    terms = ChainCost((0, 2), WEIGHTS, WEIGHTS, 1.0, candidates=(1, 2))
    position = np.array([[0.0, 0], [1, 1], [2, 2]])
    assert terms.ending_nearest(position, np.array([1.1, 1.1])) == (0, 1)
    assert terms.ending_nearest(position, np.array([1.9, 1.9])) == (0, 2)
    alone = ChainCost((0, 2), WEIGHTS, WEIGHTS, 1.0)
    assert alone.ending_nearest(position, np.array([1.1, 1.1])) == (0, 2)
    with pytest.raises(InvalidInputError, match="last node 2 among them, found \\(1,\\)"):
        ChainCost((0, 2), WEIGHTS, WEIGHTS, 1.0, candidates=(1,))


def test_no_candidate_is_avoided():
    task = StickyTask(distractors=1)
    task.reset(seed=0)
    own = TaskCost(task.cost_terms(), 2, task.cost_terms).in_scene(task.scene)
    avoid, clear = avoid_others(task.scene, (*own.order, 1, 2, 3), 0.03)
    for pairs in (avoid.pairs, clear.pairs):
        assert np.array(pairs).tolist() == [[0, 4], [1, 4], [2, 4], [3, 4]]


def test_what_was_given_up_is_avoided():
    of = trials()
    assert choose(of, 9, contact=[2]) == 2
    before = of.avoided(2)
    assert choose(of, contact=[2]) == 3
    after = of.avoided(2)
    assert np.array(before.pairs).tolist() == np.array(after.pairs).tolist()
    assert np.array(before.pairs).tolist() == [[0, 1], [0, 2], [0, 3]]
    assert np.array(before.weight).tolist() == [0, 0, 0]
    assert np.array(after.weight).tolist() == [0, 100, 0]
