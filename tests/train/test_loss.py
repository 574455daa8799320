"""The terms of the loss: by hand, and that nothing odd breaks their gradient."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.model import Nodes, gim_temp, two_type_belief
from contactgraph.train import LossTerms
from contactgraph.train.batch import Window
from contactgraph.train.loss import rollout_rmse, window_loss

DT = 0.05


class Seen(eqx.Module):
    weight: jax.Array


class Still(eqx.Module):
    """Predicts that nothing moves; its prior says 0.2, its belief 0.8, whatever happens."""

    dt: float = DT
    control_size: int = 2

    def perceive(self, position, velocity, nodes):
        exists = nodes.mask[:1] & nodes.mask[1:2] & nodes.candidate[:1]
        return Seen(jnp.where(exists, 1.0, 0.0))

    def prior_belief(self, percept):
        return two_type_belief(jnp.full(percept.weight.shape, 0.2))

    def predict_belief(self, belief, percept):
        return two_type_belief(jnp.full(percept.weight.shape, 0.8))

    def local_input(self, percept, belief, position, velocity, key):
        return percept

    def local_dynamics(self, local, dt, control_size):
        return lambda position, velocity, control: (position, velocity)

    def initial_belief(self, position, velocity, nodes):
        return two_type_belief(jnp.full(nodes.candidate.shape, 0.2))

    def rollout(self, state, controls, nodes):
        return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(controls)), state)


def nodes(batch: int, mask: list[bool]) -> Nodes:
    count = len(mask)
    return Nodes(
        actuated=jnp.broadcast_to(jnp.arange(count) == 0, (batch, count)),
        mask=jnp.broadcast_to(jnp.asarray(mask), (batch, count)),
        candidate=jnp.ones((batch, count * (count - 1) // 2), bool),
    )


def by_hand() -> Window:
    """One step: node 0 moves by 0.1 m, node 1 gains 3 m/s; in the second window nothing does."""
    position, velocity = np.zeros((2, 2, 2, 2)), np.zeros((2, 2, 2, 2))
    position[0, 1, 0, 0] = 0.1
    velocity[0, 1, 1, 1] = 3.0
    return Window(
        jnp.asarray(position), jnp.asarray(velocity), jnp.zeros((2, 1, 2)), nodes(2, [True] * 2)
    )


def test_the_terms_by_hand() -> None:
    terms = window_loss(Still(), by_hand(), jax.random.key(0), with_rollout=True)
    # 0.1 m in a step of 0.05 s weighs as 2 m/s; a rollout halves it.
    assert float(terms.prediction) == pytest.approx((2 + 3 + 0 + 0) / 4, abs=2e-3)
    assert float(terms.squared) == pytest.approx((4 + 9 + 0 + 0) / 4)
    assert float(terms.rollout) == pytest.approx((1 + 3 + 0 + 0) / 4, abs=2e-3)
    assert float(terms.prior) == pytest.approx(0.2 * math.log(0.25) + 0.8 * math.log(4))
    weights = LossTerms(prediction=1.0, squared=10.0, rollout=100.0, prior=1000.0)
    expected = 1.25 + 32.5 + 100.0 + 1000 * 0.6 * math.log(4)
    assert float(terms.total(weights)) == pytest.approx(expected, rel=1e-3)
    assert float(rollout_rmse(Still(), by_hand())) == pytest.approx(0.1 / math.sqrt(4))


def test_the_rollout_is_left_out_where_it_is_not_asked_for() -> None:
    terms = window_loss(Still(), by_hand(), jax.random.key(0), with_rollout=False)
    assert float(terms.rollout) == 0.0


def test_nodes_and_edges_that_do_not_exist_do_not_count() -> None:
    masked = dataclasses.replace(by_hand(), nodes=nodes(2, [True, False]))
    terms = window_loss(Still(), masked, jax.random.key(0), with_rollout=True)
    assert float(terms.prediction) == pytest.approx((2 + 0) / 2, abs=2e-3)
    assert float(terms.squared) == pytest.approx((4 + 0) / 2)
    assert float(terms.prior) == 0.0, "no edge, and no division by none"


def random_windows(padding: int) -> Window:
    """Two windows of 3 nodes, two of them on top of each other at rest, and some padding."""
    rng = np.random.default_rng(0)
    position = 0.1 * rng.normal(size=(2, 3, 3, 2))
    velocity = rng.normal(size=(2, 3, 3, 2))
    position[0, :, 1] = position[0, :, 0]
    velocity[0, :, :2] = 0.0
    control = rng.normal(size=(2, 2, 2))
    # Nothing moves, so predictions may be exact: where a norm has no gradient.
    position[1], velocity[1], control[1] = position[1, :1], 0.0, 0.0
    pad = ((0, 0), (0, 0), (0, padding), (0, 0))
    return Window(
        jnp.asarray(np.pad(position, pad), jnp.float32),
        jnp.asarray(np.pad(velocity, pad), jnp.float32),
        jnp.asarray(control, jnp.float32),
        nodes(2, [True] * 3 + [False] * padding),
    )


def test_the_gradient_is_finite_and_padding_changes_nothing() -> None:
    model = gim_temp(2, 2, DT, width=8, key=jax.random.key(0))

    def loss(model, windows):
        terms = window_loss(model, windows, jax.random.key(1), True)
        return terms.total(LossTerms()), terms

    _, bare = eqx.filter_jit(loss)(model, random_windows(0))
    differentiated = eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))
    (_, padded), gradient = differentiated(model, random_windows(2))
    for name, value in vars(bare).items():
        assert float(value) > 0.0, name
        assert float(getattr(padded, name)) == pytest.approx(float(value), rel=1e-5), name
    leaves = jax.tree.leaves(eqx.filter(gradient, eqx.is_inexact_array))
    assert all(np.all(np.isfinite(leaf)) for leaf in leaves)
    assert any(np.any(leaf != 0.0) for leaf in leaves)
