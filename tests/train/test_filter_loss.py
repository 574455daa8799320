"""Losses of the filter: the score of every step by hand, and which part learns from which."""

from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import CONFIG, Enough, split, window_of

from contactgraph.data import TrajectoryBatch
from contactgraph.model import HOLD, TOUCH, ContactBelief, ModelConfig, ours
from contactgraph.train import FitProgress, FitStatus, fit, initial_state
from contactgraph.train.expectation_maximisation import ExpectationMaximisation, dynamics_loss
from contactgraph.train.filter_loss import filter_loss, predict_unobserved, random_segments
from contactgraph.train.held_out import steps_between
from contactgraph.train.motion_evidence import (
    encode_evidence,
    filter_steps,
    held_where_near,
    likeliest_types,
    motion_evidence,
)

DT, LEAST = 0.05, 2e-3
MODEL = ours(ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))
KEY = jax.random.key(1)


def windows(length: int = 4) -> TrajectoryBatch:
    """A gripper that runs into a body at rest and takes it along, and one that stays away."""
    position, velocity = np.zeros((2, length + 1, 2, 2)), np.zeros((2, length + 1, 2, 2))
    velocity[:, :, 0, 0] = 1.0
    velocity[0, 2:, :, 0] = 0.5
    position[0, :, 1, 0], position[1, :, 1, 1] = 0.135, 0.16
    for step in range(length):
        position[:, step + 1] = position[:, step] + DT * velocity[:, step + 1]
    return window_of(position, velocity, np.zeros((2, length, 2)))


OBSERVED = jnp.array([[True, False, False, True], [False, True, True, False]])


@eqx.filter_jit
def both(model, given, steps=4):
    given = given._replace(steps=jnp.full(2, steps))
    judged = motion_evidence(model, given)

    def score(model):
        return filter_loss(model, given, judged, OBSERVED, KEY)

    value, slope = eqx.filter_value_and_grad(score)(model)
    return value, slope, encode_evidence(model, given, judged), judged.log_ratio


def test_the_score_is_the_likelihood_of_the_motion() -> None:
    value, slope, graph, ratio = both(MODEL, windows())
    # A fresh filter predicts the geometric prior, with every type at least 0.002 before the cutoff.
    free = LEAST + (1.0 - 3 * LEAST) * np.asarray(graph.prior)
    weight = np.asarray(graph.weight)
    active = free[..., 1:] * weight[..., None]
    types = np.concatenate([1.0 - active.sum(axis=-1, keepdims=True), active], axis=-1)
    corrects, before = np.asarray(OBSERVED), np.asarray(graph.prior)[:, 0]
    score = np.zeros(weight.shape)
    for step in range(weight.shape[1]):
        # What a fresh filter predicts does not depend on the types before.
        joint = before[..., None] * types[:, step, :, None, :]
        joint *= np.exp(np.asarray(ratio)[:, step])
        score[:, step] = -np.log(joint.sum(axis=(-2, -1)))
        after = joint.sum(axis=-2) / joint.sum(axis=(-2, -1))[..., None]
        before = np.where(corrects[:, step, None, None], after, types[:, step])
    assert float(value) == pytest.approx(score[weight > 0].mean(), rel=1e-3)
    assert np.abs(np.asarray(ratio)[0]).max() > 1.0, "the impact says something"
    others = slope.local_dynamics, slope.features
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope.inference)) > 0.0
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(others)) == 0.0


def test_steps_that_are_padding_do_not_count() -> None:
    given = windows()
    velocity = given.velocity.at[:, 2:].set(given.velocity[:, :1])  # the impact is in the next step
    missed = given._replace(velocity=velocity)
    assert float(both(MODEL, given, 1)[0]) == float(both(MODEL, missed, 1)[0])
    assert float(both(MODEL, given)[0]) != float(both(MODEL, missed)[0])


def test_the_dynamics_learn_from_the_types_of_the_very_step_and_the_inference_does_not() -> None:
    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def squared(model):
        judged, apart = motion_evidence(model, windows()), jnp.zeros(2, bool)
        return dynamics_loss(model, windows(), judged, apart).squared

    value, slope = squared(MODEL)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope.inference)) == 0.0
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope.local_dynamics)) > 0.0
    # Fresh edges hold, masses are equal: the impact is predicted because its motion was seen.
    assert float(value) < 0.05, "half of the speed in one of four steps, unpredicted, is 0.06"


def test_windows_that_are_rolled_out_count_from_their_first_state_alone() -> None:
    """A recorded state in the middle that is wrong matters to steps, but not to rollouts."""

    @eqx.filter_jit
    def terms(model, given, judged, rolled_out):
        found = dynamics_loss(model, given, judged, rolled_out)
        return found.squared, found.rollout

    given = windows()
    judged = eqx.filter_jit(motion_evidence)(MODEL, given)
    wrong = given._replace(velocity=given.velocity.at[1, 2, :, 0].add(1.0))
    own = jnp.array([False, True])
    (squared, rollout), (same, off) = (terms(MODEL, each, judged, own) for each in (given, wrong))
    assert float(squared) == float(same), "the first window's steps alone"
    # One of four states is 1 m/s off, and no other.
    assert float(off) == pytest.approx(float(rollout) + 0.25, abs=0.02)


def test_motion_corrects_the_belief_before_a_held_out_window() -> None:

    @eqx.filter_jit
    def corrected(model, given):
        evidence = motion_evidence(model, given)
        graph = encode_evidence(model, given, evidence)
        observed = jnp.ones(evidence.types.shape[:2], bool)
        return jax.vmap(partial(filter_steps, model))(graph, evidence.log_ratio, observed).after

    found = jax.tree.map(np.asarray, corrected(MODEL, windows()))
    assert found.type_probability.shape == (2, 4, 1, 3)
    assert found.memory.age.shape == (2, 4, 1, 2)
    assert found.type_probability[0, -1, 0, 0] < 0.5 < found.type_probability[1, -1, 0, 0]
    first = corrected(MODEL, steps_between(windows(), 0, 2))
    np.testing.assert_allclose(found.type_probability[:, :2], first.type_probability, atol=1e-6)


@pytest.mark.parametrize("types", [2, 3, 4])
def test_near_bodies_are_held_until_they_are_judged(types) -> None:
    active = np.array([[0.9], [0.4], [0.0]])
    prior = np.hstack([1.0 - active, np.repeat(active / (types - 1), types - 1, axis=1)])
    found = np.asarray(held_where_near(ContactBelief(jnp.asarray(prior))))
    assert list(np.argmax(found, axis=1)) == [min(2, types - 1), 0, 0]
    np.testing.assert_array_equal(found.sum(axis=1), 1.0)


def test_observations_come_in_segments() -> None:
    on = np.asarray(jax.jit(random_segments, static_argnums=1)(KEY, (200, 300)))
    assert on.mean() == pytest.approx(0.4, abs=0.03)
    changes = (on[:, 1:] != on[:, :-1]).mean()
    assert changes == pytest.approx(2 * 0.4 * 0.15, abs=0.01)


def test_states_that_are_not_observed_are_predicted() -> None:
    """A gripper that was seen to run, and stopped in time, is predicted to take the body along."""
    given = windows(length=6)
    gripper = jnp.array([-0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    body = jnp.zeros((7, 2)).at[:, 0].set(0.135)
    given = given._replace(
        position=given.position.at[0, :, 0, 0].set(gripper).at[0, :, 1].set(body),
        velocity=given.velocity.at[0].set(0.0).at[0, :2, 0, 0].set(1.0),
    )
    observed = jnp.array([[True, False, False, False, True, True], [True] * 6])

    @eqx.filter_jit
    def found(model):
        judged = motion_evidence(model, given)
        return judged, predict_unobserved(model, given, judged, observed)

    judged, (window, rolled) = found(MODEL)
    for name in ("position", "velocity"):
        recorded, predicted = np.asarray(getattr(given, name)), np.asarray(getattr(window, name))
        np.testing.assert_array_equal(predicted[1], recorded[1])
        np.testing.assert_array_equal(predicted[0, [0, 1, 5, 6]], recorded[0, [0, 1, 5, 6]])
    speed = np.linalg.norm(window.velocity[0, :, 1], axis=-1)
    assert speed[2:5].max() > 0.2 and speed[[0, 1, 5]].max() == 0.0
    # Evidence stays that of the recording, where bodies that were apart did not touch.
    change = np.asarray(rolled.log_ratio - judged.log_ratio)
    np.testing.assert_array_equal(change[1], 0.0)
    np.testing.assert_array_equal(change[..., 0], 0.0)
    begins = np.pad(observed[0], (1, 0), constant_values=True)[:-1]
    assert (change[0, ~begins, 0, :, 1:] < -1.0).all()
    np.testing.assert_array_equal(change[0, begins], 0.0)


def test_a_filter_is_trained_on_all_pairs(recorded: Path, monkeypatch) -> None:
    def stop(*rest: object) -> None:
        raise Enough

    monkeypatch.setattr(ExpectationMaximisation, "advance", stop)
    with pytest.raises(Enough):
        fit(
            *(initial_state(MODEL, CONFIG, 0), *split(recorded), CONFIG),
            near_pairs=lambda *rest: pytest.fail("no list is asked for"),
        )


@pytest.mark.slow
def test_a_filter_trains_through_its_checks(recorded: Path) -> None:
    """Both losses, the rollout term, the dead-network check and the corrected held-out windows."""
    parts = split(recorded)
    model = ours(ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))
    checks: list[FitProgress] = []
    found = fit(initial_state(model, CONFIG, 0), *parts, CONFIG, checks.append)
    assert found.status is FitStatus.finished and [each.step for each in checks] == [4, 8, 12]
    assert all(np.isfinite(list(each.terms.values())).all() for each in checks)
    assert found.held_out_rmse_m < found.baselines.standing_still_rmse_m


def test_the_steps_around_it_tell_the_type_of_a_step_that_leaves_it_open() -> None:
    steps = 8
    prior = jnp.tile(jnp.array([0.02, 0.49, 0.49]), (steps, 1, 1))
    held = jnp.array([-6.0, -2.0, 0.0])
    ratio = jnp.tile(jnp.where(jnp.eye(3, dtype=bool), held, -6.0), (steps, 1, 1, 1))
    # By itself the fourth step would say free, by a little.
    ratio = ratio.at[3, 0].set(jnp.where(jnp.eye(3, dtype=bool), jnp.array([0.0, -1, -2]), -6.0))
    likeliest = jax.jit(partial(likeliest_types, edge_types=(TOUCH, HOLD)))
    types = np.argmax(likeliest(prior, ratio), axis=-1)
    np.testing.assert_array_equal(types, np.full((steps, 1), 2))
    # Without evidence geometry decides.
    apart = jnp.tile(jnp.array([0.98, 0.01, 0.01]), (steps, 1, 1))
    assert not np.any(np.argmax(likeliest(apart, 0.0 * ratio), axis=-1))
