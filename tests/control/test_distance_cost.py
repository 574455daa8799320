"""Costs of distances: their slope, what they make a plan do, and the part of a scene."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import QuadraticCost, avoid, chain_cost, touch
from contactgraph.control.lqr import block_state
from contactgraph.control.subproblem import active_part
from contactgraph.data import InvalidInputError

H, N = 3, 4
DT = 0.1


def states(seed: int = 0) -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(seed).normal(0.0, 0.3, (H + 1, N, 2, 2)))


@pytest.mark.parametrize("dt", [0.0, DT])
@pytest.mark.parametrize("make", [avoid, touch])
def test_its_expansion_has_the_slope_of_the_cost_in_the_first_of_each_pair(
    make, dt, double_precision
) -> None:
    weight = np.linspace(1.0, 2.0, 2 * (H + 1)).reshape(H + 1, 2)
    cost = make([(0, 2), (1, 3)], [0.6, 0.3], weight, dt)
    at, ids = states(), jnp.array([1, 0])
    assert np.all(np.asarray(cost.by_step(at)) >= 0.0)

    def moved(x):
        return jnp.sum(cost.by_step(at.at[:, ids].set(jnp.moveaxis(x, 1, 2))))

    x = jnp.moveaxis(at[:, ids], 2, 1)
    slope = jax.grad(moved)(x).reshape(H + 1, -1)
    Q, q = cost.expanded(at, ids)
    whole = jnp.stack([block_state(each[:, 0], each[:, 1], ids) for each in at])
    assert np.max(np.abs(slope)) > 0.1
    np.testing.assert_allclose(2.0 * (jnp.einsum("tij,tj->ti", Q, whole) + q), slope, atol=1e-9)
    assert np.all(np.linalg.eigvalsh(Q) > -1e-9)


def test_bodies_that_pass_between_two_states_are_near_in_between() -> None:
    at = jnp.zeros((1, 2, 2, 2)).at[0, 0].set(jnp.array([[0.3, 0.05], [6.0, 0.0]]))
    apart = avoid([(0, 1)], 0.1, 4.0)
    np.testing.assert_allclose(apart.by_step(at), 0.0)
    passed = replace(apart, dt=0.1)  # from -0.3 to 0.3, at 0.05 m beside the other
    np.testing.assert_allclose(passed.by_step(at), 4.0 * 0.05**2, rtol=1e-5)


def test_what_it_costs_of_one_pair() -> None:
    at = jnp.zeros((1, 2, 2, 2)).at[0, 1, 0, 0].set(0.5)
    assert float(avoid([(0, 1)], 0.7, 2.0).by_step(at)[0]) == pytest.approx(2.0 * 0.2**2)
    assert float(touch([(0, 1)], 0.4, 2.0).by_step(at)[0]) == pytest.approx(2.0 * 0.1**2)
    both = avoid([(0, 1)], 0.7, 2.0).joined(touch([(1, 0)], 0.4, np.full((1, 1), 2.0)))
    assert float(both.by_step(at)[0]) == pytest.approx(2.0 * (0.2**2 + 0.1**2))
    cost = QuadraticCost(jnp.zeros((8, 8)), jnp.eye(2), jnp.zeros(8), distances=both)
    assert float(cost(at, jnp.zeros((0, 2)))) == pytest.approx(0.1)


def test_a_part_of_a_scene_leaves_out_pairs_with_nodes_that_are_not_in_it() -> None:
    cost = chain_cost((0, 1), np.ones(4), np.ones(4), 1.0, np.zeros(2), 6)
    cost = replace(cost, distances=avoid([(0, 2), (0, 4), (1, 4)], [0.1, 0.2, 0.3], 5.0))
    motion = np.zeros((6, 2)), np.zeros((6, 2))
    scene = nodes_of(6, 6), cost
    part = active_part(scene, np.array([0, 1, 4, -1]), np.array([0, 1]), motion).cost.distances
    assert part is not None
    inside = np.asarray(part.weight) > 0.0
    assert inside.tolist() == [False, True, True]
    assert np.asarray(part.pairs)[inside].tolist() == [[0, 2], [1, 2]]
    assert np.asarray(part.distance)[inside].tolist() == pytest.approx([0.2, 0.3])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: avoid([(1, 1)], 0.1, 1.0), "pairs must name two different nodes"),
        (lambda: avoid([(0, -1)], 0.1, 1.0), "pairs must name two different nodes"),
        (lambda: touch([(0, 1)], np.nan, 1.0), "distance must be finite"),
        (lambda: touch([(0, 1)], 0.1, -1.0), "weight must be finite and not negative"),
        (lambda: avoid([(0, 1)], 0.1, 1.0, np.inf), "dt must be finite"),
        (
            lambda: avoid([(0, 1)], 0.1, 1.0).joined(avoid([(0, 1)], 0.1, 1.0, 0.1)),
            "must have the same dimension and dt",
        ),
    ],
)
def test_what_is_refused(wrong, message) -> None:
    with pytest.raises(InvalidInputError, match=message):
        wrong()
