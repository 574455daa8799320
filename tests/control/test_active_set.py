"""Who is in play, and what stays known when others are: on the host, without a model."""

import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import chain_cost
from contactgraph.control.in_play import Surroundings, always_in_play, padded, room_for, staying
from contactgraph.control.part import part_of
from contactgraph.control.swept_bounds import SweptBounds
from contactgraph.data import pair_indices
from contactgraph.model import InteractionCutoff, Nodes

NEAR = InteractionCutoff(distance=0.2, dt=0.1)
HORIZON = 10
ALONE = np.array([0]), np.array([True])
"""Who is in play: one, always."""


def swept_of(*ways) -> SweptBounds:
    """Of nodes that go from one place to another at an even pace; and of no other rollout."""
    part = np.linspace(0.0, 1.0, HORIZON + 1)[:, None, None]
    ways = np.array(ways, float)
    path = ways[:, 0] + part * (ways[:, 1] - ways[:, 0])
    lower, upper = np.minimum(path[1:], path[:-1]), np.maximum(path[1:], path[:-1])
    nothing = np.full_like(lower, np.inf)
    return SweptBounds(np.stack([lower, nothing]), np.stack([upper, -nothing]))


def missing(position, velocity=None, swept=None) -> list[int]:
    """Of nodes around one that goes 1 m to the right; they are numbered from 5 on."""
    place = np.zeros((5 + len(position), 2))
    place[5:] = position
    speed = np.zeros_like(place)
    speed[5:] = 0.0 if velocity is None else velocity
    around = Surroundings.seen(np.arange(5, len(place)), (place, speed))
    way = swept_of([(0.0, 0.0), (1.0, 0.0)]) if swept is None else swept
    who = np.array([0, -1])[: np.asarray(way.lower).shape[2]]
    return around.missing(way, who, who == 0, NEAR).tolist()


def test_whoever_is_near_the_way_is_missing_and_the_nearest_comes_first():
    assert missing([(0.5, 0.19), (0.5, 0.25), (-0.1, 0.0), (1.25, 0.0), (0.3, -0.3)]) == [7, 5]


def test_who_is_within_another_reach_is_named_besides():
    around = Surroundings(np.array([5, 6, 7, 8]), np.zeros((4, 2)), np.zeros(4))
    around.position[:] = (0.5, 0.4), (0.5, -0.3), (0.5, 0.1), (0.5, 0.5)
    way = swept_of([(0.0, 0.0), (1.0, 0.0)])
    assert around.missing(way, *ALONE, NEAR).tolist() == [7]
    assert around.missing(way, *ALONE, NEAR, reaches=2.0).tolist() == [7, 6, 5]


def test_the_box_around_a_way_across_is_not_the_way():
    across = swept_of([(0.0, 0.0), (1.0, 1.0)])
    assert missing([(0.9, 0.1), (0.6, 0.5)], swept=across) == [6]


def test_each_rollout_has_a_way_of_its_own():
    one, other = swept_of([(0.0, 0.0), (1.0, 1.0)]), swept_of([(0.0, 0.0), (1.0, -1.0)])
    both = SweptBounds(
        np.concatenate([one.lower, other.lower]), np.concatenate([one.upper, other.upper])
    )
    assert missing([(0.9, 0.0), (0.9, -0.9)], swept=both) == [6]


def test_padding_of_those_in_play_has_been_nowhere():
    with_padding = swept_of([(0.0, 0.0), (1.0, 0.0)], [(0.0, 2.0), (0.0, 2.0)])
    assert missing([(0.0, 2.0)], swept=with_padding) == []
    nowhere = SweptBounds.nowhere(2, HORIZON, jnp.zeros((1, 2)))
    assert missing([(0.0, 0.0)], swept=nowhere) == []


def test_who_moves_may_come_nearer_and_push_others_as_far():
    away = [(0.5, 0.3), (0.5, -0.3), (3.0, 3.0)]
    assert missing(away) == []
    assert missing(away, [(0.0, 0.0), (0.0, 0.0), (0.19, 0.0)]) == [5, 6]
    # What is fast is in play itself, so it can be told whom it pushes.
    assert missing(away, [(0.0, 0.0), (0.0, 0.0), (0.3, 0.0)]) == [7]
    assert missing([(0.5, 1e30)], [(0.0, 1e30)]) == [5]


def still(x, y=0.25):
    return (x, y), (x, y)


def test_neighbours_of_one_in_play_matter_once_it_moves():
    around = np.array([(0.0, 0.0), (1.4, 0.25)])
    around = Surroundings(np.array([5, 6]), around, np.zeros(2))
    way, who, always = [(0.0, 1.0), (1.0, 0.3)], np.array([0, 2]), np.array([True, False])
    assert around.missing(swept_of(way, still(1.2)), who, always, NEAR).tolist() == []
    moved = (1.2, 0.25), (1.22, 0.25)
    assert around.missing(swept_of(way, moved), who, always, NEAR).tolist() == [6]
    both = np.array([True, True])
    assert around.missing(swept_of(way, still(1.2)), who, both, NEAR).tolist() == [6]


def test_who_stays_is_near_one_that_moves_and_stays():
    motion = np.zeros((9, 2)), np.zeros((9, 2))
    others = [still(1.1), still(1.35), still(4.0), still(0.0)]
    swept = swept_of([(0.0, 0.0), (1.0, 0.0)], *others)
    who = np.array([0, 2, 3, 8, -1])
    always = who == 0
    assert staying(swept, who, always, motion, NEAR).tolist() == [0, 2]
    motion[1][8] = 1.0
    assert staying(swept, who, always, motion, NEAR).tolist() == [0, 2, 8]
    others[0] = [(1.05, 0.25), (1.15, 0.25)]
    swept = swept_of([(0.0, 0.0), (1.0, 0.0)], *others)
    assert staying(swept, who, always, motion, NEAR).tolist() == [0, 2, 3, 8]


def test_rooms_are_three_times_as_large_as_the_one_before_or_all():
    assert [room_for(count, 99) for count in (1, 2, 3, 6, 7, 18, 19)] == [2, 2, 6, 6, 18, 18, 54]
    assert [room_for(count, 9) for count in (2, 3, 6, 7)] == [2, 6, 6, 9]
    assert [room_for(count, 8) for count in (2, 3, 6, 7)] == [2, 8, 8, 8]
    assert padded(np.array([7, 2]), 4).tolist() == [2, 7, -1, -1]


def test_who_is_always_in_play():
    nodes = nodes_of(6, 8)
    pick = chain_cost((0, 4), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, (0, 0), 8)
    assert always_in_play(nodes, pick).tolist() == [0, 4]
    anchor = jnp.full((8, 2), jnp.nan).at[3].set(0.0)
    hung = Nodes(nodes.actuated, nodes.mask, nodes.candidate, anchor)
    assert always_in_play(hung, pick).tolist() == [0, 3, 4]


def test_a_part_has_the_edges_and_the_costs_of_its_nodes():
    nodes = nodes_of(6, 8)
    listed = jnp.asarray([first == 2 or second == 4 for first, second in pair_indices(8)])
    nodes = Nodes(nodes.actuated, nodes.mask, nodes.candidate & listed, None)
    pick = chain_cost((4, 0), [3, 2, 0.2, 0.1], [50, 40, 1, 2], 0.01, (0.3, 0.6), 8)
    who = np.array([0, 2, 4, 5, -1])
    part = part_of(nodes, pick, who, np.array([0, 4]), 2)
    assert part.nodes.mask.tolist() == [True, True, True, True, False]
    edges = pair_indices(5)[np.asarray(part.nodes.candidate)].tolist()
    assert edges == [[0, 2], [1, 2], [1, 3]]
    assert part.left_out.tolist() == [1, 3] and part.cost.involved.tolist() == [2, 0]
    assert part.always.tolist() == [True, False, True, False, False]
    rng = np.random.default_rng(0)
    state = rng.normal(size=(3, 8, 4))
    ours = np.where(who[:, None] >= 0, state[:, who], 0.0).reshape(3, -1)
    control = rng.normal(size=(2, 2))
    wanted = pick(jnp.asarray(state.reshape(3, -1)), jnp.asarray(control))
    assert float(part.cost(jnp.asarray(ours), jnp.asarray(control))) == pytest.approx(float(wanted))
