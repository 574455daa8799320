import dataclasses
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, compiled, crowd, nodes_of

from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.model import (
    HOLD,
    ContactSensor,
    ModelConfig,
    correct,
    motion_noise,
)
from contactgraph.model.filter import filter_trajectory
from contactgraph.relations import relations
from contactgraph.relations.inference import (
    StaticEdges,
    edge_posterior,
    motion_sums,
    with_evidence,
)

STIFFNESS = 3.0


def with_spring_law(model, share=1.0):
    """The model with the law of a spring in place of its network, and shares of the ends."""

    def parts(each):
        local = each.local_dynamics
        last = local.message_passing.types[0].network.layers[-1]
        numbers = local.gain, local.log_damping, local.log_noise, local.log_share
        return (last.weight, last.bias, local.message_passing.share, *numbers)

    values = (0.0, STIFFNESS, share, 1.0, -10.0, -1.0, -1.0)
    filled = [
        jnp.broadcast_to(jnp.asarray(value, leaf.dtype), leaf.shape)
        for value, leaf in zip(values, parts(model), strict=True)
    ]
    return eqx.tree_at(parts, model, filled)


@pytest.fixture(scope="module")
def springs():
    config = ModelConfig(2, 2, DT, contact_distance=0.3, width=8, edge_types=(HOLD,))
    return with_spring_law(relations(config, key=jax.random.key(0)))


def by_enumeration(log_prior, G, b):
    """Exact marginals [E, K], and the likeliest types [E]."""
    edges, types = log_prior.shape
    every = np.array(list(product(range(types), repeat=edges)))
    scores = []
    for choice in every:
        z = np.eye(types)[choice][:, 1:].ravel()
        prior = log_prior[np.arange(edges), choice].sum()
        scores.append(prior + b @ z - 0.5 * z @ G @ z)
    weight = np.exp(np.array(scores) - np.max(scores))
    weight /= weight.sum()
    return np.einsum("c,cek->ek", weight, np.eye(types)[every]), every[np.argmax(scores)]


def test_edges_that_share_no_body_follow_bayes_rule():
    rng = np.random.default_rng(0)
    log_prior = np.log(rng.dirichlet(np.ones(3), size=4))
    blocks = rng.normal(size=(4, 5, 2))
    G = np.zeros((8, 8))
    for edge, block in enumerate(blocks):
        G[2 * edge : 2 * edge + 2, 2 * edge : 2 * edge + 2] = block.T @ block
    b = rng.normal(size=8)
    found = compiled(edge_posterior, *map(jnp.asarray, (log_prior, G, b)))
    np.testing.assert_allclose(found, by_enumeration(log_prior, G, b)[0], rtol=2e-4, atol=2e-6)


def test_coupled_edges_are_found_as_by_enumeration():
    rng = np.random.default_rng(1)
    infer = eqx.filter_jit(edge_posterior)
    log_prior = np.full((10, 2), np.log(0.5))
    pairs = np.array(list(zip(*np.triu_indices(5, 1), strict=True)))
    for _ in range(10):
        Phi = np.zeros((3, 5, 2, 10))  # three steps of five bodies
        for edge, (i, j) in enumerate(pairs):
            Phi[:, i, :, edge] = rng.normal(size=(3, 2))
            Phi[:, j, :, edge] = -Phi[:, i, :, edge]
        truth = rng.integers(2, size=10)
        residual = Phi @ truth + 0.3 * rng.normal(size=(3, 5, 2))
        G, b = motion_sums(Phi, residual, np.full((3, 5), 0.3))
        found = np.asarray(infer(*map(jnp.asarray, (log_prior, G, b))))
        assert np.array_equal(found.argmax(axis=1), by_enumeration(log_prior, G, b)[1])


def test_evidence_of_two_parts_is_that_of_the_whole_and_reports_count():
    rng = np.random.default_rng(2)
    edges = StaticEdges(1)
    known = np.stack([np.log([0.5, 0.5])] * 6)
    first = edges.init(jnp.asarray(np.hstack([known, np.ones((6, 1))])), jnp.exp(known))
    Phi = rng.normal(size=(8, 4, 2, 6))
    residual = Phi @ rng.integers(2, size=6) + rng.normal(size=(8, 4, 2))
    G, b = (
        np.stack(each)
        for each in zip(
            *(motion_sums(*p, np.full(4, 2.0)) for p in zip(Phi, residual, strict=True)),
            strict=True,
        )
    )
    once = with_evidence(first, jnp.asarray(G.sum(0)), jnp.asarray(b.sum(0)))
    parts = first
    for half in (slice(0, 4), slice(4, 8)):
        parts = with_evidence(parts, jnp.asarray(G[half].sum(0)), jnp.asarray(b[half].sum(0)))
    np.testing.assert_allclose(parts.type_probability, once.type_probability, rtol=1e-4)
    report = jnp.full(6, jnp.nan).at[2].set(1.0)
    told = correct(first, report, ContactSensor(0.1, 0.1))
    after = with_evidence(told, jnp.zeros((6, 6)), jnp.zeros(6))
    np.testing.assert_allclose(after.probability, [0.5, 0.5, 0.9, 0.5, 0.5, 0.5], rtol=1e-4)


def believing(state, joined):
    """The state with these probabilities [E] that edges are active."""
    log_types = jnp.log(jnp.maximum(np.stack([1.0 - joined, joined], -1), 1e-9))
    memory = dataclasses.replace(state.belief.memory, log_types=log_types)
    return dataclasses.replace(state, belief=memory.belief())


def test_a_step_is_the_midpoint_rule(springs):
    nodes = nodes_of(3)
    state = crowd(springs, nodes)
    p = np.array([1.0, 0.25, 0.0])
    state = believing(state, p)
    control = jnp.array([0.7, -0.2])
    after = compiled(springs.step, state, control, nodes)
    x, v = np.asarray(state.position), np.asarray(state.velocity)
    middle = x + 0.5 * DT * v
    weights = np.zeros((3, 3))
    weights[[0, 0, 1], [1, 2, 2]] = p
    weights = weights + weights.T
    a = STIFFNESS * np.einsum("ij,ijd->id", weights, middle[None] - middle[:, None])
    a[0] += control
    np.testing.assert_allclose(after.velocity, v + DT * a, atol=1e-5)
    np.testing.assert_allclose(after.position, x + DT * v + 0.5 * DT**2 * a, atol=1e-6)


def test_one_way_shares_move_the_receiver_alone(springs):
    nodes = nodes_of(2)  # the first is actuated: types object (0), actuated (1)
    share = np.array([[[0.0, 1.0], [0.0, 0.0]]])  # [receiver, sender]
    model = with_spring_law(springs, share)
    state = crowd(model, nodes)
    state = believing(state, np.ones(1))
    change = compiled(model.step, state, jnp.zeros(2), nodes).velocity - state.velocity
    np.testing.assert_allclose(change[0], 0.0, atol=1e-6)
    assert np.linalg.norm(change[1]) > 1e-3


class WithinOneUnit(eqx.Module):
    def __call__(self, distance):
        return jnp.maximum(1.0 - distance, 0.0)


def test_a_relation_is_active_within_its_range_alone(springs):
    laws = [WithinOneUnit()]
    model = eqx.tree_at(lambda each: each.local_dynamics.message_passing.types, springs, laws)
    position = jnp.array([[0.0, 0.0], [0.15, 0.0], [0.9, 0.0]])  # the unit is 0.3 m
    belief = compiled(model.initial_belief, position, jnp.zeros((3, 2)), nodes_of(3))
    np.testing.assert_allclose(belief.probability, [0.5, 0.0, 0.0], atol=1e-6)


def rolled_out(model, joined, steps, nodes, seed=0):
    """A trajectory of the model itself under the true types."""
    state = crowd(model, nodes, seed=seed, size=0.4)
    state = believing(state, joined)
    control = jnp.zeros((steps, 2))
    after = compiled(model.rollout, state, control, nodes)
    position = jnp.concatenate([state.position[None], after.position])
    velocity = jnp.concatenate([state.velocity[None], after.velocity])
    return TrajectoryBatch(position, velocity, control, None, nodes, jnp.asarray(steps))


JOINED = np.array([1.0, 0.0, 0.0, 1.0, 1.0, 0.0])
filtered = eqx.filter_jit(filter_trajectory)


@pytest.fixture(scope="module")
def run(springs):
    return rolled_out(springs, JOINED, 12, nodes_of(4))


def test_motion_finds_the_springs_and_nothing_else_does(springs, run):
    found = filtered(springs, run, ContactSensor(), motion_noise(springs))
    after = np.asarray(found.posterior.probability)
    np.testing.assert_allclose(after[0], 0.5, atol=1e-6)
    assert np.abs(after[-1] - JOINED).max() < 1e-2
    np.testing.assert_allclose(found.prior.probability, after, atol=1e-6)  # relations last
    unseen = filtered(springs, run, ContactSensor(), None).posterior.probability
    np.testing.assert_allclose(unseen, 0.5, atol=1e-6)


def test_padding_changes_no_belief(springs, run):
    small = filtered(springs, run, ContactSensor(), motion_noise(springs)).posterior.probability
    space = ((0, 0), (0, 2), (0, 0))
    padded = run._replace(
        position=jnp.pad(run.position, space),
        velocity=jnp.pad(run.velocity, space),
        nodes=nodes_of(4, capacity=6),
    )
    large = filtered(springs, padded, ContactSensor(), motion_noise(springs)).posterior.probability
    np.testing.assert_allclose(large[:, :6], small, atol=1e-4)
    assert large[:, 6:].max() < 1e-5
