"""Active nodes and their part of a scene, on the host, without a model."""

import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import chain_cost
from contactgraph.control.rollout import SweptBounds
from contactgraph.control.subproblem import (
    ActiveBounds,
    active_part,
    bucket_size,
    padded,
    required_nodes,
)
from contactgraph.data import pair_indices
from contactgraph.model import Nodes

NEAR, DT = 0.2, 0.1
HORIZON = 10


def swept_of(*ways) -> SweptBounds:
    """Of nodes that go from one point to another at an even pace."""
    part = np.linspace(0.0, 1.0, HORIZON + 1)[:, None, None]
    ways = np.array(ways, float)
    path = ways[:, 0] + part * (ways[:, 1] - ways[:, 0])
    lower, upper = np.minimum(path[1:], path[:-1]), np.maximum(path[1:], path[:-1])
    return SweptBounds(lower, upper)


def missing(position, velocity=None, swept=None, cutoffs=1.0) -> list[int]:
    """Of nodes around one that goes 1 m to the right; their ids begin with 5."""
    place = np.zeros((5 + len(position), 2))
    place[5:] = position
    speed = np.zeros_like(place)
    speed[5:] = 0.0 if velocity is None else velocity
    path = swept_of([(0.0, 0.0), (1.0, 0.0)]) if swept is None else swept
    active = np.array([0, -1])[: np.asarray(path.lower).shape[1]]
    bounds = ActiveBounds(path, active, active == 0, NEAR, DT)
    others = np.arange(5, len(place))
    return bounds.nodes_to_add(others, (place, speed), cutoffs).tolist()


def test_nodes_near_the_path_are_added_the_nearest_first():
    assert missing([(0.5, 0.19), (0.5, 0.25), (-0.1, 0.0), (1.25, 0.0), (0.3, -0.3)]) == [7, 5]


def test_nodes_within_two_cutoffs_follow_those_within_one():
    around = [(0.5, 0.4), (0.5, -0.3), (0.5, 0.1), (0.5, 0.5)]
    assert missing(around) == [7]
    assert missing(around, cutoffs=2.0) == [7, 6, 5]


def test_nodes_drift_until_the_last_step_of_the_plan():
    # 10 steps of 0.01 m towards the end of the path: near after 10 of them, not after 9.
    reach, speed = 1.05 * NEAR, [(-0.1, 0.0)]
    assert missing([(1.0 + reach + 0.095, 0.0)], speed) == [5]
    assert missing([(1.0 + reach + 0.105, 0.0)], speed) == []


def test_the_box_around_a_diagonal_path_is_not_the_path():
    across = swept_of([(0.0, 0.0), (1.0, 1.0)])
    assert missing([(0.9, 0.1), (0.6, 0.5)], swept=across) == [6]


def test_padding_has_no_bounds():
    with_padding = swept_of([(0.0, 0.0), (1.0, 0.0)], [(0.0, 2.0), (0.0, 2.0)])
    assert missing([(0.0, 2.0)], swept=with_padding) == []
    nothing = np.full((HORIZON, 1, 2), np.inf)
    nowhere = SweptBounds(nothing, -nothing)
    assert missing([(0.0, 0.0)], swept=nowhere) == []


def test_a_moving_node_may_approach_and_move_others_as_far():
    away = [(0.5, 0.3), (0.5, -0.3), (3.0, 3.0)]
    assert missing(away) == []
    assert missing(away, [(0.0, 0.0), (0.0, 0.0), (0.19, 0.0)]) == [5, 6]
    # A fast node is active itself, so that its own bounds say what it pushes.
    assert missing(away, [(0.0, 0.0), (0.0, 0.0), (0.3, 0.0)]) == [7]
    assert missing([(0.5, 1e30)], [(0.0, 1e30)]) == [5]


def still(x, y=0.25):
    return (x, y), (x, y)


def test_neighbours_of_an_active_node_matter_once_it_moves():
    position = np.zeros((7, 2))
    position[5:] = (0.0, 0.0), (1.4, 0.25)
    path, moved = [(0.0, 1.0), (1.0, 0.3)], ((1.2, 0.25), (1.22, 0.25))

    def added(other, required) -> list[int]:
        bounds = ActiveBounds(swept_of(path, other), np.array([0, 2]), np.array(required), NEAR, DT)
        return bounds.nodes_to_add(np.array([5, 6]), (position, np.zeros((7, 2)))).tolist()

    assert added(still(1.2), [True, False]) == []
    assert added(moved, [True, False]) == [6]
    assert added(still(1.2), [True, True]) == [6]


def test_a_node_is_kept_near_a_kept_one_that_moves():
    motion = np.zeros((9, 2)), np.zeros((9, 2))
    others = [still(1.1), still(1.35), still(4.0), still(0.0)]
    swept = swept_of([(0.0, 0.0), (1.0, 0.0)], *others)
    active = np.array([0, 2, 3, 8, -1])

    def kept(swept) -> list[int]:
        return ActiveBounds(swept, active, active == 0, NEAR, DT).nodes_to_keep(motion).tolist()

    assert kept(swept) == [0, 2]
    motion[1][8] = 1.0
    assert kept(swept) == [0, 2, 8]
    others[0] = [(1.05, 0.25), (1.15, 0.25)]
    assert kept(swept_of([(0.0, 0.0), (1.0, 0.0)], *others)) == [0, 2, 3, 8]


def test_bucket_sizes_triple_up_to_the_capacity():
    assert [bucket_size(count, 99) for count in (1, 2, 3, 6, 7, 18, 19)] == [2, 2, 6, 6, 18, 18, 54]
    assert [bucket_size(count, 9) for count in (2, 3, 6, 7)] == [2, 6, 6, 9]
    assert [bucket_size(count, 8) for count in (2, 3, 6, 7)] == [2, 8, 8, 8]
    assert padded(np.array([7, 2]), 4).tolist() == [2, 7, -1, -1]


def test_actuated_hinged_and_cost_nodes_are_required():
    nodes = nodes_of(6, 8)
    pick = chain_cost((0, 4), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, (0, 0), 8)
    assert required_nodes(nodes, pick).tolist() == [0, 4]
    anchor = jnp.full((8, 2), jnp.nan).at[3].set(0.0)
    hung = Nodes(nodes.actuated, nodes.mask, nodes.candidate, anchor)
    assert required_nodes(hung, pick).tolist() == [0, 3, 4]


def test_a_part_has_the_edges_and_the_costs_of_its_nodes():
    nodes = nodes_of(6, 8)
    listed = jnp.asarray([first == 2 or second == 4 for first, second in pair_indices(8)])
    reach = jnp.full((8, 2, 2), jnp.nan).at[4].set(jnp.array([[-0.2, -0.3], [0.1, 0.2]]))
    nodes = nodes._replace(candidate=nodes.candidate & listed, reach=reach)
    pick = chain_cost((4, 0), [3, 2, 0.2, 0.1], [50, 40, 1, 2], 0.01, (0.3, 0.6), 8)
    ids = np.array([0, 2, 4, 5, -1])
    rest = np.zeros((8, 2)), np.zeros((8, 2))
    part = active_part((nodes, pick), ids, np.array([0, 4]), rest)
    assert part.nodes.mask.tolist() == [True, True, True, True, False]
    edges = pair_indices(5)[np.asarray(part.nodes.candidate)].tolist()
    assert edges == [[0, 2], [1, 2], [1, 3]]
    np.testing.assert_array_equal(part.nodes.reach, reach[ids])
    assert part.inactive.tolist() == [1, 3] and part.cost.cost_node_ids.tolist() == [2, 0]
    assert part.required.tolist() == [True, False, True, False, False]
    rng = np.random.default_rng(0)
    state = rng.normal(size=(3, 8, 4))
    ours = np.where(ids[:, None] >= 0, state[:, ids], 0.0).reshape(3, -1)
    control = rng.normal(size=(2, 2))
    wanted = pick(jnp.asarray(state.reshape(3, -1)), jnp.asarray(control))
    assert float(part.cost(jnp.asarray(ours), jnp.asarray(control))) == pytest.approx(float(wanted))
