"""Lists of near pairs: what is in them, and that nothing else matters."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, assert_same, crowd, hinged, nodes_of, preset

from contactgraph.bodies.geometry import travel_bound
from contactgraph.bodies.graph import edge_nodes
from contactgraph.data import InvalidInputError
from contactgraph.data.graph import pair_indices
from contactgraph.large_scenes import NeighborList, allocate_neighbor_list
from contactgraph.large_scenes.neighbor_list import unordered_edge_id
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    ModelConfig,
    Nodes,
    SmoothCutoff,
    check_motion_model,
    correct,
    load_model,
    save_model,
    two_type_belief,
)

FAR = 0.25


@partial(jax.jit, static_argnums=0)
def list_pairs(lists, position, way, mask):
    return lists(position, way, mask, FAR)


def listed(position, way=None, mask=None, edges=400, cell=30):
    """Pairs of the list, as a set, and whether they fit."""
    count = len(position)
    way = np.zeros(count) if way is None else way
    mask = np.ones(count, bool) if mask is None else mask
    found = list_pairs(NeighborList(max_edges=edges, cell_capacity=cell), position, way, mask)
    number = np.asarray(found.edge_id)
    real = number < count * (count - 1) // 2
    assert (np.diff(number[real]) > 0).all()  # each once, ascending
    np.testing.assert_array_equal(found.edge_index.T[real], pair_indices(count)[number[real]])
    np.testing.assert_array_equal(found.edge_index.T[~real], 0)
    return {tuple(pair) for pair in np.asarray(found.edge_index.T)[real].tolist()}, bool(found.fits)


@pytest.mark.parametrize("cell", [30, None])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_list_has_the_near_pairs_each_once(dimension: int, cell: int | None) -> None:
    rng = np.random.default_rng(dimension)
    # Wider than the numbered cells, so that some of them share a number.
    size = {2: 3.0, 3: 1.4}[dimension]
    position = rng.uniform(-size, size, (60, dimension)).astype(np.float32)
    way = rng.uniform(0.0, 0.1, 60).astype(np.float32)
    mask = rng.random(60) < 0.9
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    near = (distance < FAR + way[:, None] + way) & mask[:, None] & mask
    found, fits = listed(position, way, mask, cell=cell)
    assert fits and len(found) > 5
    assert found == {(i, j) for i, j in pair_indices(60).tolist() if near[i, j]}


def test_coincident_padding_fills_no_cell() -> None:
    position = np.zeros((40, 2), np.float32)
    position[:2] = [[0.0, 0.1], [0.1, 0.0]]
    assert listed(position, mask=np.arange(40) < 2, cell=2) == ({(0, 1)}, True)


def test_overflow_is_reported() -> None:
    position = np.random.default_rng(0).uniform(0, 0.15, (10, 2)).astype(np.float32)
    assert listed(position, edges=45, cell=10)[1]
    assert not listed(position, edges=44, cell=10)[1]
    assert not listed(position, edges=45, cell=3)[1]


def test_pair_indices_and_back() -> None:
    second = np.array([1, 2, 3, 100, 4095, 4096, 46_338, 46_339], np.int32)
    for first in (np.zeros_like(second), second // 2, second - 1):
        pairs = edge_nodes(unordered_edge_id(jnp.asarray(first), jnp.asarray(second)), 46_340).T
        np.testing.assert_array_equal(pairs, np.stack([first, second], axis=1))
    np.testing.assert_array_equal(
        unordered_edge_id(*jnp.asarray(pair_indices(9)).T), np.arange(36, dtype=np.int32)
    )


def test_more_nodes_than_can_be_numbered_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="at most 46340 nodes, found 46341"):
        eqx.filter_eval_shape(
            NeighborList(max_edges=1, cell_capacity=1),
            jnp.zeros((46_341, 2)),
            jnp.zeros(46_341),
            jnp.ones(46_341, bool),
            FAR,
        )


def rolled(model: ContactDynamics, nodes: Nodes, size: float):
    """States of a rollout, and the gradient of something that depends on all of them."""
    state = crowd(model, nodes, size=size)
    controls = jnp.full((3, 2), 3.0)
    weights, static = eqx.partition(model, eqx.is_inexact_array)

    def total(weights):
        states = eqx.combine(weights, static).rollout(state, controls, nodes)
        return jnp.sum(states.velocity**2) + jnp.sum(states.position), states

    return jax.jit(jax.grad(total, has_aux=True))(weights)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize(
    ("name", "hinges"),
    [
        pytest.param("recurrent", False, marks=pytest.mark.slow),
        pytest.param("recurrent", True, marks=pytest.mark.slow),
    ],
)
def test_predictions_and_gradients_are_those_of_all_pairs(name: str, hinges: bool) -> None:
    nodes = nodes_of(12, 14)
    if hinges:
        nodes = hinged(nodes, (0.1, 0.2), (-0.3, 0.1))
    model = preset(name, hinges=hinges)
    near = dataclasses.replace(
        model, neighbor_list=NeighborList(max_edges=60, cell_capacity=12, group_capacity=12)
    )
    gradient, every = rolled(model, nodes, size=0.6)
    near_gradient, states = rolled(near, nodes, size=0.6)
    pairs = len(pair_indices(14))
    listed_edges = np.asarray(states.belief.edge_id)
    # Lists are short, and change: beliefs are carried over from one to the next.
    assert (listed_edges < pairs).sum(axis=1).max() < 50
    assert (listed_edges[0] != listed_edges[-1]).any()
    assert (np.asarray(every.belief.probability) > 0.5).any()
    belief = jax.vmap(lambda one: one.over(None, pairs))(states.belief)
    found = states.position, states.velocity, belief.type_probability
    wanted = every.position, every.velocity, every.belief.type_probability
    assert_same(found, wanted, rtol=1e-9, atol=1e-9)
    assert_same(near_gradient, gradient, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_an_overflowing_list_predicts_nan() -> None:
    nodes = nodes_of(6)
    model = preset("recurrent")
    state = crowd(model, nodes)
    for lists in (
        NeighborList(max_edges=3, cell_capacity=6),
        NeighborList(max_edges=3, cell_capacity=None, group_capacity=None),
        NeighborList(max_edges=20, cell_capacity=1),
        NeighborList(max_edges=20, cell_capacity=6, group_capacity=1),
    ):
        small = dataclasses.replace(model, neighbor_list=lists)
        after = eqx.filter_jit(small.step)(state, jnp.ones(2), nodes)
        assert np.isnan(np.asarray(after.position)).all()
        assert np.isnan(np.asarray(after.velocity)).all()


def test_neighbor_lists_are_allocated_for_a_scene() -> None:
    nodes = nodes_of(20, 23)
    model = dataclasses.replace(preset("recurrent"), cutoff=SmoothCutoff(inner=0.1, outer=FAR))
    state = crowd(model, nodes, size=0.4)
    way = travel_bound(state.position, state.velocity, None, None, DT)
    pairs, _ = listed(state.position, way, nodes.mask)
    given = state.position, state.velocity, nodes
    tight = allocate_neighbor_list(model, *given, spare=1.0).neighbor_list
    assert tight.max_edges == len(pairs) > 20
    assert listed(state.position, way, nodes.mask, len(pairs), tight.cell_capacity)[1]
    assert not listed(state.position, way, nodes.mask, len(pairs), tight.cell_capacity - 1)[1]
    roomy = allocate_neighbor_list(model, *given).neighbor_list
    assert (roomy.max_edges, roomy.cell_capacity) == (
        -(-3 * tight.max_edges // 2),
        -(-3 * tight.cell_capacity // 2),
    )


@pytest.mark.parametrize("spacing", [0.3, 1.0, 3.0])
def test_a_list_for_a_lattice_is_one_at_any_speed(spacing: float) -> None:
    """Cells repeat, and become longer with the fastest node; none of the lattice's is fuller."""
    nodes = nodes_of(40, 40)
    model = dataclasses.replace(preset("recurrent"), cutoff=SmoothCutoff(inner=0.1, outer=FAR))
    lattice = np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2)
    position = jnp.asarray(spacing * lattice, jnp.float32)
    found = allocate_neighbor_list(model, position, jnp.zeros((40, 2)), nodes).neighbor_list
    for way in np.linspace(0.0, 0.5 * (spacing - FAR), 400, endpoint=False):
        _, fits = listed(position, jnp.full(40, way), nodes.mask, 40, found.cell_capacity)
        assert fits


def test_a_bar_is_near_as_far_as_it_reaches() -> None:
    anchor = np.array([[np.nan, np.nan], [0.0, 0.0]])
    position, velocity = np.array([[0.0, 0.9], [0.5, 0.0]]), np.array([[0.0, 0.0], [0.0, 2.0]])
    way = travel_bound(*map(jnp.asarray, (position, velocity)), None, jnp.asarray(anchor), DT)
    np.testing.assert_allclose(way, [0.0, 0.5 + 2 * 2.0 * DT], rtol=1e-6)


def test_beliefs_go_from_list_to_list_by_pair() -> None:
    old = ContactBelief(
        jnp.asarray([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7], [1.0, 0.0]]), jnp.asarray([2, 5, 7, 10])
    )
    new = old.over(jnp.asarray([1, 5, 7, 9, 10]), 10)
    np.testing.assert_allclose(new.probability, [0.0, 0.8, 0.7, 0.0, 0.0], atol=1e-6)
    every = new.over(None, 10)
    np.testing.assert_allclose(np.flatnonzero(every.probability), [5, 7])
    assert every.over(None, 10) is every
    again = every.over(new.edge_id, 10)
    np.testing.assert_array_equal(again.type_probability, new.type_probability)


def test_measured_contacts_are_those_of_all_pairs() -> None:
    measured = jnp.asarray([1.0, jnp.nan, 0.0, 1.0, 0.0, 1.0])
    sensor = ContactSensor(jnp.linspace(0.1, 0.2, 6), 0.3)
    every = two_type_belief(jnp.linspace(0.1, 0.9, 6))
    edge = jnp.asarray([1, 2, 5, 6])
    near = jax.jit(correct)(every.over(edge, 6), measured, sensor)
    whole = jax.jit(correct)(every, measured, sensor).probability
    np.testing.assert_allclose(near.probability, [*whole[jnp.asarray([1, 2, 5])], 0.0], atol=1e-6)
    np.testing.assert_array_equal(near.edge_id, edge)


def near_pairs(name: str, max_edges: int = 9, cell_capacity: int = 9) -> ContactDynamics:
    lists = NeighborList(max_edges=max_edges, cell_capacity=cell_capacity)
    return dataclasses.replace(preset(name), neighbor_list=lists)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: near_pairs("no_inference"), r"need a cutoff with a finite outer.*found NoCutoff"),
        (lambda: near_pairs("recurrent", 4, 0), "cell_capacity must be at least 1, found 0"),
        (lambda: check_motion_model(near_pairs("recurrent")), "must have no neighbor list"),
    ],
)
def test_where_lists_cannot_be_they_are_refused(wrong: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        wrong()


def test_a_model_file_has_no_neighbor_list(tmp_path: Path) -> None:
    model, near = preset("recurrent"), near_pairs("recurrent", max_edges=5000)
    config = ModelConfig(2, 2, DT, width=16)
    listed, every = tmp_path / "listed.safetensors", tmp_path / "every.safetensors"
    save_model(listed, near, "ours-recurrent", config)
    save_model(every, model, "ours-recurrent", config)
    assert listed.read_bytes() == every.read_bytes()
    assert load_model(listed).model.neighbor_list is None


def test_a_step_takes_beliefs_of_all_pairs_too() -> None:
    nodes = nodes_of(6)
    model, near = preset("recurrent"), near_pairs("recurrent", 20, 6)
    state = crowd(model, nodes)
    linear, belief = eqx.filter_jit(near.linear_step)(state, jnp.ones(2), nodes)
    expected, every = eqx.filter_jit(model.linear_step)(state, jnp.ones(2), nodes)
    np.testing.assert_allclose(linear.A, expected.A, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(belief.over(None, 15).probability, every.probability, atol=1e-5)
