"""Expectation maximisation: what is expected of every step, and which part learns from which."""

from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import CONFIG, Enough, split, window_of

from contactgraph.data import TrajectoryBatch
from contactgraph.model import ContactBelief, ModelConfig, ours
from contactgraph.train import FitProgress, FitStatus, fit, initial_state
from contactgraph.train.expectation_maximisation import (
    ExpectationMaximisation,
    dynamics_loss,
    transition_loss,
)
from contactgraph.train.held_out import steps_between
from contactgraph.train.motion_evidence import (
    encode_evidence,
    filter_steps,
    held_where_near,
    motion_evidence,
    smoothed_steps,
)

DT = 0.05
MODEL = ours(ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))


def windows(length: int = 4) -> TrajectoryBatch:
    """A gripper that runs into a body at rest and takes it along, and one that stays away."""
    position, velocity = np.zeros((2, length + 1, 2, 2)), np.zeros((2, length + 1, 2, 2))
    velocity[:, :, 0, 0] = 1.0
    velocity[0, 2:, :, 0] = 0.5
    position[0, :, 1, 0], position[1, :, 1, 1] = 0.135, 0.16
    for step in range(length):
        position[:, step + 1] = position[:, step] + DT * velocity[:, step + 1]
    return window_of(position, velocity, np.zeros((2, length, 2)))


@eqx.filter_jit
def classified(model, given, steps=4):
    given = given._replace(steps=jnp.full(2, steps))
    evidence = motion_evidence(model, given)
    loss = eqx.filter_value_and_grad(transition_loss)
    return *loss(model, given, evidence), encode_evidence(model, given, evidence), evidence


def test_transitions_learn_to_classify_the_expected_ones_and_nothing_else_learns() -> None:
    value, slope, graph, evidence = classified(MODEL, windows())
    transitions = np.asarray(jax.vmap(jax.vmap(MODEL.transitions))(graph))
    cross = -(np.asarray(evidence.flow) * np.log(np.maximum(transitions, 1e-6))).sum((-3, -2, -1))
    within = np.asarray(graph.weight) > 0
    # The odds of fresh transitions are the same at every age, and so cost nothing.
    assert float(value) == pytest.approx(cross[within].mean(), rel=1e-4)
    assert np.abs(np.asarray(evidence.log_ratio)[0]).max() > 1.0, "the impact says something"
    others = slope.local_dynamics, slope.features
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(slope.inference)) > 0.0
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(others)) == 0.0


def test_steps_that_are_padding_do_not_count() -> None:
    given = windows()
    moved = given._replace(position=given.position.at[1, 3:, 1, 1].add(-0.06))
    first, second = (float(classified(MODEL, each, 1)[0]) for each in (given, moved))
    assert first == pytest.approx(second, rel=1e-6)
    assert float(classified(MODEL, given)[0]) != pytest.approx(
        float(classified(MODEL, moved)[0]), rel=1e-3
    )


def test_recorded_contacts_tell_types_where_they_are_read() -> None:
    """A body that rests beside the gripper, which motion leaves open."""
    still = windows()
    still = still._replace(position=still.position[:, :1] + 0.0 * still.position)
    still = still._replace(velocity=0.0 * still.velocity)
    still = still._replace(position=still.position.at[:, :, 1].set(jnp.array([0.084, 0.0])))

    @eqx.filter_jit
    def types(contact):
        given = still if contact is None else still._replace(contact=jnp.full((2, 5, 1), contact))
        return jnp.sum(motion_evidence(MODEL, given).flow, axis=(-3, -2))[0, -1, 0]

    contact, none, unknown, alone = (types(each) for each in (1.0, 0.0, jnp.nan, None))
    assert none[0] > 0.9 > 0.1 > contact[0]
    np.testing.assert_allclose(unknown, alone, atol=1e-6)


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
        return jax.vmap(partial(filter_steps, model))(graph, evidence.log_ratio).after

    found = jax.tree.map(np.asarray, corrected(MODEL, windows()))
    assert found.type_probability.shape == (2, 4, 1, 3)
    assert found.memory.age.shape == (2, 4, 1, 3, 44)
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
    """Bodies side by side, which are held by the motion of all steps but one."""
    near, steps = windows(8), 8
    near = near._replace(position=near.position.at[:, :, 1].set(near.position[:, :, 0] + 0.06))
    held = jnp.where(jnp.eye(3, dtype=bool), jnp.array([-6.0, -2.0, 0.0]), -6.0)
    ratio = jnp.tile(held, (steps, 1, 1, 1))
    # By itself the fourth step would say free, by a little.
    ratio = ratio.at[3, 0].set(jnp.where(jnp.eye(3, dtype=bool), jnp.array([0.0, -1, -2]), -6.0))

    @eqx.filter_jit
    def types(ratio):
        graph = encode_evidence(MODEL, near, motion_evidence(MODEL, near))
        graph = jax.tree.map(lambda leaf: leaf[0], graph)
        return jnp.argmax(jnp.sum(smoothed_steps(MODEL, graph, ratio), axis=(-3, -2)), axis=-1)

    np.testing.assert_array_equal(types(ratio), np.full((steps, 1), 2))
