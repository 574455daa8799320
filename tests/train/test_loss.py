"""The terms of the loss: by hand, and that nothing odd breaks their gradient."""

import dataclasses
import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import window_of

from contactgraph.data import TrajectoryBatch
from contactgraph.model import HOLD, PRESETS, LinearDynamics, ModelConfig, two_type_belief
from contactgraph.train import LossTerms
from contactgraph.train.held_out import rollout_rmse
from contactgraph.train.window_loss import rollout_loss, window_loss

DT = 0.05


@eqx.filter_jit
def jitted_loss(model, windows: TrajectoryBatch) -> LossTerms:
    terms = window_loss(model, windows, jax.random.key(0))
    return dataclasses.replace(terms, rollout=rollout_loss(model, windows))


jitted_rmse = eqx.filter_jit(rollout_rmse)


class Moving(eqx.Module):
    position: jax.Array
    velocity: jax.Array


class Graph(eqx.Module):
    bodies: Moving
    control: jax.Array
    weight: jax.Array
    control_displacement: jax.Array


class Still(eqx.Module):
    """Predicts that nothing moves; its prior is 0.2, its belief 0.8, always."""

    dt: float = DT
    control_size: int = 2
    neighbor_list: None = None
    gain: float = 0.0

    @property
    def inference(self):
        return self

    @property
    def edge_types(self):
        return (HOLD,)

    def encode(self, position, velocity, control, nodes, before, meeting=None):
        exists = nodes.mask[:1] & nodes.mask[1:2] & nodes.candidate[:1]
        # Of what moves with the control: what is believed to hold.
        held = jnp.sum(before.holding)
        moved = self.gain * held * jnp.stack([control, control])
        return Graph(Moving(position, velocity), control, jnp.where(exists, 1.0, 0.0), moved)

    def prior_belief(self, graph):
        return two_type_belief(jnp.full(graph.weight.shape, 0.2))

    def predict_belief(self, belief, graph):
        return two_type_belief(jnp.full(graph.weight.shape, 0.8))

    def cut_edges(self, graph, belief, key=None):
        return graph

    def linearize(self, local):
        blocks = jnp.zeros((*local.bodies.position.shape, 2, 2))
        return LinearDynamics(blocks + jnp.eye(2), blocks, blocks[..., 0])

    def initial_belief(self, position, velocity, nodes):
        return two_type_belief(jnp.full(nodes.candidate.shape, 0.2))

    def rollout(self, state, controls, nodes):
        return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(controls)), state)


def by_hand(mask: list[bool] | None = None) -> TrajectoryBatch:
    """One step: node 0 moves by 0.1 m, node 1 gains 3 m/s; in the second window nothing does."""
    position, velocity = np.zeros((2, 2, 2, 2)), np.zeros((2, 2, 2, 2))
    position[0, 1, 0, 0] = 0.1
    velocity[0, 1, 1, 1] = 3.0
    return window_of(position, velocity, np.zeros((2, 1, 2)), mask)


def test_the_terms_by_hand() -> None:
    terms = jitted_loss(Still(), by_hand())
    # 0.1 m in a step of 0.05 s weighs as 2 m/s; a rollout halves it.
    assert float(terms.prediction) == pytest.approx((2 + 3 + 0 + 0) / 4, abs=2e-3)
    assert float(terms.squared) == pytest.approx((4 + 9 + 0 + 0) / 4)
    assert float(terms.rollout) == pytest.approx((1 + 3 + 0 + 0) / 4, abs=2e-3)
    assert float(terms.prior) == pytest.approx(0.2 * math.log(0.25) + 0.8 * math.log(4))
    weights = LossTerms(prediction=1.0, squared=10.0, rollout=100.0, prior=1000.0)
    expected = 1.25 + 32.5 + 100.0 + 1000 * 0.6 * math.log(4)
    assert float(terms.total(weights)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_switch_and_the_lack_of_a_control_change_no_term() -> None:
    model = PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=4), key=jax.random.key(0))
    rng = np.random.default_rng(0)
    window = window_of(*(0.1 * rng.normal(size=(2, 2, 3, 2, 2))), np.zeros((2, 2, 2)))

    def terms(size: int, control: jax.Array) -> list[float]:
        sized = dataclasses.replace(model, control_size=size)
        windows = window._replace(control=control)
        found = jitted_loss(sized, windows)
        return [float(each) for each in jax.tree.leaves(found)]

    still = terms(2, jnp.zeros((2, 2, 2)))
    np.testing.assert_allclose(terms(0, jnp.zeros((2, 2, 0))), still, rtol=1e-5)
    switched = jnp.zeros((2, 2, 3)).at[..., 2].set(1.0)
    np.testing.assert_allclose(terms(3, switched), still, rtol=1e-5)
    assert not np.allclose(terms(2, 5.0 + jnp.zeros((2, 2, 2))), still, rtol=1e-2)


def test_the_held_out_error_is_that_of_rollouts_over_the_counted_bodies() -> None:
    model, windows = Still(), by_hand()
    belief = two_type_belief(jnp.full((2, 1), 0.2))
    first = jnp.array([[True, False], [False, False]])
    assert float(jitted_rmse(model, windows, belief, first)) == pytest.approx(0.1)
    # The mean over windows of each one's root: 0.1 m of one node of two, and nothing.
    everybody = float(jitted_rmse(model, windows, belief, jnp.ones((2, 2), bool)))
    assert everybody == pytest.approx((0.1 / math.sqrt(2) + 0.0) / 2)


def test_nodes_and_edges_that_do_not_exist_do_not_count() -> None:
    masked = by_hand([True, False])
    terms = jitted_loss(Still(), masked)
    assert float(terms.prediction) == pytest.approx((2 + 0) / 2, abs=2e-3)
    assert float(terms.squared) == pytest.approx((4 + 0) / 2)
    assert float(terms.prior) == 0.0, "no edge, and no division by none"
    # The rollout misses by (2 m/s) / 2 in one window and not at all in the other.
    assert float(terms.rollout) == pytest.approx((1 + 0) / 2, abs=2e-3)


def test_static_bodies_keep_their_edges_but_their_motion_does_not_count() -> None:
    pillar = jnp.array([[False, True], [False, True]])
    windows = by_hand()
    windows = windows._replace(nodes=windows.nodes._replace(static=pillar))
    terms = jitted_loss(Still(), windows)
    assert float(terms.prediction) == pytest.approx((2 + 0) / 2, abs=2e-3)
    assert float(terms.squared) == pytest.approx((4 + 0) / 2)
    assert float(terms.rollout) == pytest.approx((1 + 0) / 2, abs=2e-3)
    assert float(terms.prior) == pytest.approx(0.2 * math.log(0.25) + 0.8 * math.log(4))


class Pushed(Still):
    """Velocities become the control displacement given; its gain is learned."""

    gain: jax.Array = eqx.field(default_factory=lambda: jnp.ones(()))

    def linearize(self, local):
        keep = jnp.zeros((*local.bodies.position.shape, 2, 2)).at[..., 0, 0].set(1.0)
        displacement = local.control_displacement
        offset = jnp.stack([jnp.zeros_like(displacement), displacement], axis=-1)
        return LinearDynamics(keep, jnp.zeros_like(keep), offset)


def test_training_tells_each_step_the_belief_before_it() -> None:
    """That of the first step is the prior, 0.2; later ones are 0.8."""
    control = np.array([[[3.0, 0.0], [0.0, 5.0], [7.0, 0.0]]])
    expected = np.zeros((1, 4, 2, 2))
    expected[0, 1:] = (np.array([0.2, 0.8, 0.8])[:, None] * control[0])[:, None]
    window = window_of(np.zeros((1, 4, 2, 2)), expected, control)
    found = jitted_loss(Pushed(), window)
    assert float(found.squared) == pytest.approx(0.0, abs=1e-9)


def random_windows(padding: float) -> TrajectoryBatch:
    """Two windows of 3 nodes, two of them on top of each other at rest, and of 2 masked ones."""
    rng = np.random.default_rng(0)
    position = 0.1 * rng.normal(size=(2, 3, 3, 2))
    velocity = rng.normal(size=(2, 3, 3, 2))
    position[0, :, 1] = position[0, :, 0]
    velocity[0, :, :2] = 0.0
    control = rng.normal(size=(2, 2, 2))
    # Nothing moves, so predictions may be exact: where a norm has no gradient.
    position[1], velocity[1], control[1] = position[1, :1], 0.0, 0.0

    pad = ((0, 0), (0, 0), (0, 2), (0, 0))
    states = (np.pad(each, pad, constant_values=padding) for each in (position, velocity))
    return window_of(*states, control, [True] * 3 + [False] * 2)


def test_the_gradient_is_finite_and_padding_changes_nothing() -> None:
    model = PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))

    @eqx.filter_jit
    @partial(eqx.filter_value_and_grad, has_aux=True)
    def loss(model, windows):
        terms = window_loss(model, windows, jax.random.key(1))
        terms = dataclasses.replace(terms, rollout=rollout_loss(model, windows))
        return terms.total(LossTerms()), terms

    (_, terms), gradient = loss(model, random_windows(0.0))
    (_, padded), other = loss(model, random_windows(0.07))
    for name, value in vars(terms).items():
        assert float(value) > 0.0 or name in ("likelihood", "noise"), name
        assert float(getattr(padded, name)) == pytest.approx(float(value), rel=1e-5), name
    leaves, others = (
        jax.tree.leaves(eqx.filter(each, eqx.is_inexact_array)) for each in (gradient, other)
    )
    for ours, theirs in zip(leaves, others, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6)
    assert all(np.all(np.isfinite(leaf)) for leaf in leaves)
    assert any(np.any(leaf != 0.0) for leaf in leaves)
