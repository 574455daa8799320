"""Costs: the chain by hand, the paper's convention, relative coordinates, and what is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import chain_cost
from contactgraph.control.learned_cost import (
    independent_part,
    isotropic_axes,
    relative_basis,
    relative_terms,
)
from contactgraph.data import InvalidInputError

PICK, GOAL = [3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0]


def test_chain_cost_is_the_sum_of_its_terms():
    rng = np.random.default_rng(0)
    cost = chain_cost([2, 0, 3], PICK, GOAL, 0.01, [0.3, -0.2], node_count=5)
    states, controls = rng.normal(size=(2, 5, 4)), rng.normal(size=(1, 2))
    expected = 0.01 * np.sum(controls**2)
    for gripper, first, last in states[:, [2, 0, 3]]:
        expected += np.sum(PICK * (gripper - first) ** 2) + np.sum(PICK * (first - last) ** 2)
        expected += np.sum(GOAL * (last - [0.3, -0.2, 0, 0]) ** 2)
    found = cost(jnp.asarray(states.reshape(2, -1)), jnp.asarray(controls))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_array_equal(cost.Q, cost.Q.T)


def test_terminal_weight_counts_for_the_last_step_only():
    cost = chain_cost([0], PICK, GOAL, 0.01, [0.0, 0.0], node_count=1)
    heavy = dataclasses.replace(cost, terminal_weight=jnp.asarray(7.0))
    states, controls = jnp.ones((3, 4)), jnp.zeros((2, 2))
    one = float(np.sum(GOAL))
    np.testing.assert_allclose(cost(states, controls), 3 * one)
    np.testing.assert_allclose(heavy(states, controls), 9 * one)


def test_time_varying_cost():
    cost = chain_cost([0], PICK, GOAL, 0.01, [0.0, 0.0], node_count=1)
    factor = jnp.asarray([1.0, 2.0, 4.0])
    varying = dataclasses.replace(cost, Q=factor[:, None, None] * cost.Q)
    np.testing.assert_allclose(varying(jnp.ones((3, 4)), jnp.zeros((2, 2))), 7 * np.sum(GOAL))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chain": [0, 5]}, "nodes 0 to 4, found \\[0, 5\\]"),
        ({"chain": [1, 1]}, "different nodes"),
        ({"pick_weights": [1.0]}, "pick_weights must have shape \\(4,\\), found \\(1,\\)"),
        ({"goal_weights": [1, 1, 1, -1]}, "goal_weights must be finite and not negative"),
        ({"control_weight": 0.0}, "control_weight must be positive, found 0.0"),
        ({"goal": [np.nan, 0.0]}, "goal must be D finite numbers"),
    ],
)
def test_mistakes_are_named(change, message):
    arguments = {
        "chain": [0, 1],
        "pick_weights": PICK,
        "goal_weights": GOAL,
        "control_weight": 0.01,
        "goal": [0.0, 0.0],
        "node_count": 5,
    }
    with pytest.raises(InvalidInputError, match=message):
        chain_cost(**(arguments | change))


PICKS, GOALS = np.array([3.0, 4.0, 0.2, 0.3]), np.array([50.0, 40.0, 1.0, 2.0])
EVEN = isotropic_axes(np.zeros(2))


def test_a_chains_terms_stand_alone():
    cost = chain_cost((0, 1, 2), PICKS, GOALS, 0.01, (1.0, 2.0), 3)
    assert np.allclose(relative_terms(cost.Q, 2), np.diag([*PICKS, *PICKS, *GOALS]), atol=1e-5)


@pytest.mark.parametrize(("nodes", "dimension"), [(1, 1), (2, 2), (3, 3)])
def test_any_cost_has_terms_and_they_give_it_back(nodes, dimension):
    size = 2 * nodes * dimension
    root = np.random.default_rng(0).normal(size=(size, size))
    Q = root @ root.T
    T = relative_basis(nodes, dimension)
    assert np.allclose(T.T @ relative_terms(Q, dimension) @ T, Q)


def test_the_independent_part_is_an_orthogonal_projection():
    root = np.random.default_rng(1).normal(size=(8, 8))
    W = root @ root.T
    part = np.asarray(independent_part(W, EVEN))
    assert np.allclose(independent_part(part, EVEN), part, atol=1e-5)
    assert abs(np.sum((W - part) * part)) < 1e-3 * np.sum(part**2)
    # Of one term: the mean over the axes, and position tied to velocity of the same axis.
    assert part[0, 0] == pytest.approx((W[0, 0] + W[1, 1]) / 2, rel=1e-5)
    assert part[0, 2] == part[1, 3] == pytest.approx((W[0, 2] + W[1, 3]) / 2, rel=1e-5)
    # Neither across terms nor across axes.
    assert not part[:4, 4:].any() and part[0, 1] == part[0, 3] == 0.0


def test_gravity_separates_an_axis():
    assert np.allclose(isotropic_axes(np.zeros(2)), 0.5)
    upright = isotropic_axes(np.array([0.0, 0.0, -9.81]))
    assert np.allclose(upright, [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    W = np.diag([1.0, 3.0, 7.0, 0.0, 0.0, 0.0])
    assert np.allclose(np.diag(independent_part(W, upright))[:3], [2.0, 2.0, 7.0])
