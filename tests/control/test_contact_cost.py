"""Costs of contacts: their slope, what they make a plan do, and the part of a scene."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import StickyBodies, nodes_of, state_of

from contactgraph.control import (
    ILQR,
    AffinePolicy,
    QuadraticCost,
    avoid,
    chain_cost,
    hold,
    keep_clear,
    touch,
)
from contactgraph.control.lqr import block_state
from contactgraph.control.subproblem import active_part, required_nodes
from contactgraph.data import InvalidInputError
from contactgraph.data.graph import edge_id, pair_indices
from contactgraph.model import ContactBelief

H, N = 3, 4
by_step = eqx.filter_jit(lambda cost, *given: cost.by_step(*given))
expanded = eqx.filter_jit(lambda cost, *given: cost.expanded(*given))


def states(seed: int = 0) -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(seed).normal(0.0, 0.3, (H + 1, N, 2, 2)))


def beliefs(types: int = 3, count: int = N, steps: int = H) -> ContactBelief:
    rng = np.random.default_rng(7)
    return ContactBelief(
        jnp.asarray(rng.dirichlet(np.ones(types), (steps, len(pair_indices(count)))))
    )


@pytest.mark.parametrize("make", [avoid, touch, hold, partial(keep_clear, distance=[0.6, 0.3])])
def test_its_expansion_has_value_and_slope_of_the_cost_in_the_first_of_each_pair(
    make, double_precision
) -> None:
    weight = np.linspace(1.0, 2.0, 2 * (H + 1)).reshape(H + 1, 2)
    weight = weight if isinstance(make, partial) else weight[:H]
    cost = make([(0, 2), (1, 3)], weight=weight)
    at, ids = states(), jnp.array([1, 0])
    believed = beliefs()
    of_step = np.asarray(by_step(cost, at, believed))
    assert np.all(of_step >= 0.0)
    here = at[:, :, 0]
    length = jnp.linalg.norm(here[:, [0, 1]] - here[:, [2, 3]], axis=-1)

    def nearby(x):
        """What the expansion says that it is near."""
        moved = at.at[:, ids].set(jnp.moveaxis(x, 1, 2))
        if make not in (avoid, touch, hold):
            return cost.by_step(moved, believed)
        apart = moved[:, [0, 1], 0] - moved[:, [2, 3], 0]
        part = jnp.linalg.norm(apart, axis=-1) / length
        part = 2.0 - part if make is avoid else part
        return jnp.sum(part**2 * cost._costs(at, believed)[0], axis=-1)

    x = jnp.moveaxis(at[:, ids], 2, 1)
    np.testing.assert_allclose(nearby(x), of_step, atol=1e-12)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(nearby(x))))(x).reshape(H + 1, -1)
    Q, q = expanded(cost, at, believed, ids)
    whole = jnp.stack([block_state(each[:, 0], each[:, 1], ids) for each in at])
    assert np.max(np.abs(slope)) > 0.1
    np.testing.assert_allclose(2.0 * (jnp.einsum("tij,tj->ti", Q, whole) + q), slope, atol=1e-9)
    assert np.all(np.linalg.eigvalsh(Q) > -1e-9)


def test_a_cost_of_beliefs_is_the_expected_number_of_steps_that_are_not_as_wanted() -> None:
    believed = beliefs()
    at = jnp.zeros((H + 1, N, 2, 2)).at[:, 3, 0, 0].set(0.5)
    types = np.asarray(believed.type_probability)[:, edge_id(1, 3)]
    for make, probability in (
        (avoid, 1.0 - types[:, 0]),
        (touch, 1.25 * types[:, 0]),
        (hold, 1.25 * (types[:, 0] + types[:, 1])),
    ):
        found = make([(3, 1)], 2.0).by_step(at, believed)
        np.testing.assert_allclose(found, [*(2.0 * probability), 0.0], rtol=1e-5)
    over_time = touch([(3, 1)], np.array([[0.0], [1.0], [4.0]])).by_step(at, believed)
    np.testing.assert_allclose(over_time, [*(1.25 * types[:, 0] * [0.0, 1.0, 4.0]), 0.0], rtol=1e-5)


def test_pairs_that_are_not_listed_touch_nothing() -> None:
    listed = ContactBelief(jnp.full((1, 1, 2), 0.5), jnp.array([[edge_id(0, 1)]]))
    at = jnp.zeros((2, N, 2, 2))
    assert float(avoid([(0, 1), (0, 2)], 1.0).by_step(at, listed)[0]) == pytest.approx(0.5)
    assert float(touch([(0, 1), (0, 2)], 1.0).by_step(at, listed)[0]) == pytest.approx(1.5)


@eqx.filter_jit
def planned(cost, guess):
    begin = state_of([[0.0, 0.0], [0.3, 0.0]], np.zeros((2, 2)), [0.0])
    return ILQR(10).solve(StickyBodies(), begin, nodes_of(2, 2), cost, guess)


def test_a_plan_seeks_a_contact_that_pays_for_nothing_else() -> None:
    """Without the cost of contact the hand stays where it is; with it, it goes and sticks."""
    nothing = QuadraticCost(1e-6 * jnp.eye(8), 0.01 * jnp.eye(2), jnp.zeros(8))
    nothing = replace(nothing, cost_node_ids=jnp.array([0, 1]))
    idle = AffinePolicy(jnp.zeros((10, 2, 2, 2, 2)), jnp.zeros((10, 2)))
    still = planned(replace(nothing, contacts=(touch([(0, 1)], 0.0),)), idle)
    assert np.max(np.abs(np.asarray(still.states)[:, 0, 0])) < 0.01
    seeking = planned(replace(nothing, contacts=(touch([(0, 1)], 10.0),)), idle)
    assert float(seeking.beliefs.probability[-1, 0]) > 0.9
    assert seeking.cost < 10.0 * 10 * 1.09 * 0.98


def test_what_it_costs_of_one_pair() -> None:
    at = jnp.zeros((1, 2, 2, 2)).at[0, 1, 0, 0].set(0.5)
    none = beliefs(2, 2, 0)
    near = keep_clear([(0, 1)], 0.7, 2.0)
    assert float(near.by_step(at, none)[0]) == pytest.approx(2.0 * 0.2**2)
    twice = QuadraticCost(jnp.zeros((8, 8)), jnp.eye(2), jnp.zeros(8), contacts=(near, near))
    assert float(twice(at, jnp.zeros((0, 2)), none)) == pytest.approx(4.0 * 0.2**2)
    with pytest.raises(InvalidInputError, match="needs the plan's beliefs"):
        twice(at, jnp.zeros((0, 2)))


def test_a_part_of_a_scene_leaves_out_pairs_with_nodes_that_are_not_in_it() -> None:
    cost = chain_cost((0, 1), np.ones(4), np.ones(4), 1.0, np.zeros(2), 6)
    pairs = [(0, 2), (0, 4), (1, 4)]
    cost = replace(cost, contacts=(keep_clear(pairs, [0.1, 0.2, 0.3], 5.0), avoid(pairs, 3.0)))
    motion = np.zeros((6, 2)), np.zeros((6, 2))
    scene = nodes_of(6, 6), cost
    part = active_part(scene, np.array([0, 1, 4, -1]), np.array([0, 1]), motion).cost.contacts
    for each in part:
        inside = np.asarray(each.weight) > 0.0
        assert inside.tolist() == [False, True, True]
        assert np.asarray(each.pairs)[inside].tolist() == [[0, 2], [1, 2]]
    assert np.asarray(part[0].distance)[inside].tolist() == pytest.approx([0.2, 0.3])


def test_a_body_that_is_to_be_touched_is_always_active() -> None:
    cost = chain_cost((0, 1), np.ones(4), np.ones(4), 1.0, np.zeros(2), 6)
    avoiding = replace(cost, contacts=(avoid([(0, 5)], 1.0), keep_clear([(0, 4)], 1.0, 1.0)))
    assert required_nodes(nodes_of(6, 6), avoiding).tolist() == [0, 1]
    seeking = replace(cost, contacts=(touch([(0, 5)], 1.0), hold([(1, 3)], 1.0)))
    assert required_nodes(nodes_of(6, 6), seeking).tolist() == [0, 1, 3, 5]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: avoid([(1, 1)], 1.0), "pairs must name two different nodes"),
        (lambda: hold([(0, -1)], 1.0), "pairs must name two different nodes"),
        (lambda: keep_clear([(0, 1)], np.nan, 1.0), "distance must be finite"),
        (lambda: touch([(0, 1)], -1.0), "weight must be finite and not negative"),
    ],
)
def test_what_is_refused(wrong, message) -> None:
    with pytest.raises(InvalidInputError, match=message):
        wrong()
