"""Relative coordinates: the paper's costs are diagonal in them, and nothing is lost."""

import numpy as np
import pytest

from contactgraph.control import chain_cost
from contactgraph.control.learned_cost import (
    independent_part,
    isotropic_axes,
    relative_basis,
    relative_names,
    relative_terms,
)

PICK, GOAL = np.array([3.0, 4.0, 0.2, 0.3]), np.array([50.0, 40.0, 1.0, 2.0])
EVEN = isotropic_axes(None, 2)


def test_a_chains_terms_stand_alone():
    cost = chain_cost((0, 1, 2), PICK, GOAL, 0.01, (1.0, 2.0), 3)
    assert np.allclose(relative_terms(cost.Q, 2), np.diag([*PICK, *PICK, *GOAL]), atol=1e-5)


@pytest.mark.parametrize(("nodes", "dimension"), [(1, 1), (2, 2), (3, 3)])
def test_any_cost_has_terms_and_they_give_it_back(nodes, dimension):
    size = 2 * nodes * dimension
    root = np.random.default_rng(0).normal(size=(size, size))
    Q = root @ root.T
    T = relative_basis(nodes, dimension)
    assert np.allclose(T.T @ relative_terms(Q, dimension) @ T, Q)


def test_names_state_node_and_reference():
    assert relative_names(("gripper", "cup")) == ("gripper - cup", "cup - goal")


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
    assert np.allclose(isotropic_axes(None, 2), 0.5)
    upright = isotropic_axes(np.array([0.0, 0.0, -9.81]), 3)
    assert np.allclose(upright, [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    W = np.diag([1.0, 3.0, 7.0, 0.0, 0.0, 0.0])
    assert np.allclose(np.diag(independent_part(W, upright))[:3], [2.0, 2.0, 7.0])
