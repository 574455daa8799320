"""Many optimiser steps in one compiled call, then the held-out error."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.inference.features import InvariantFeatures
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import BatchSplit, Window, WindowSource, add_distractor
from contactgraph.train.config import TrainConfig
from contactgraph.train.fit_state import FitState
from contactgraph.train.held_out import HeldOutWindows, rollout_rmse
from contactgraph.train.loss import LossTerms, objective_of, rollout_loss

_CLEARANCE = 1.03
"""Least distance of a distractor, in learned contact distances."""
_SHORTEST = 0.1
"""Least learned contact distance, in first guesses."""


def optimiser_of(config: TrainConfig, steps: int | None = None) -> optax.GradientTransformation:
    """Adam with a rate that rises and then falls along a cosine."""
    steps = config.steps if steps is None else steps
    rate = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=min(100, steps),
        decay_steps=max(steps, min(100, steps) + 1),
        end_value=0.01 * config.learning_rate,
    )
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))


def with_positive_distance(model: ContactDynamics) -> ContactDynamics:
    """The model with a learned contact distance of at least a tenth of its first guess.

    A negative one would turn the sign of the contact prior. A bound and not a softplus, because
    model files hold the distance itself.
    """
    features = model.features
    if not (isinstance(features, InvariantFeatures) and features.learned):
        return model
    bounded = jnp.maximum(features.contact_distance, _SHORTEST * features.length)
    return eqx.tree_at(lambda each: each.features.contact_distance, model, bounded)


def in_lengths(updates: ContactDynamics) -> ContactDynamics:
    """Updates of a learned contact distance in units of its first guess, not of metres.

    Only impacts tell the distance. Beyond the way of a step from the true one it has no gradient,
    and a few updates of millimetres led there, to stay.
    """
    features = updates.features
    if not (isinstance(features, InvariantFeatures) and features.learned):
        return updates
    scaled = features.length * features.contact_distance
    return eqx.tree_at(lambda each: each.features.contact_distance, updates, scaled)


def scored(
    state: FitState,
    error: Float[Array, ""],
    better: Bool[Array, ""],
    counts: Bool[Array, ""] | bool,
) -> FitState:
    """The state after a check: its model is the best one where it is ``better``, and a check
    without gain is one where it ``counts``, since the loss may not hold rollouts yet."""
    best = jax.tree.map(
        lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new,
        state.model,
        state.best_model,
    )
    waits = better | ~jnp.asarray(counts)
    return dataclasses.replace(
        state,
        best_model=best,
        best_error=jnp.where(better, error, state.best_error),
        checks_without_gain=jnp.where(waits, 0, state.checks_without_gain + 1),
    )


@eqx.filter_jit
def advance_steps(
    state: FitState,
    source: WindowSource,
    checked: HeldOutWindows,
    config: TrainConfig,
    count: int,
    distractors: int,
    with_rollout: Bool[np.ndarray, ""] | None,
    split: BatchSplit | None,
) -> tuple[FitState, dict[str, Array]]:
    """`count` optimiser steps in one scan, then the held-out error.

    ``with_rollout`` is an argument of one compiled program, because a second program would take as
    long to compile as to run. None: the rollout term is not compiled at all.
    """
    optimiser = optimiser_of(config)
    # Just outside the learned contact distance, so that training determines that distance.
    nearest = _CLEARANCE * jnp.asarray(state.model.features.contact_distance)
    params, static = eqx.partition(state.model, eqx.is_inexact_array)
    devices = 1 if split is None else split.mesh.size

    def drawn(draw_key: PRNGKeyArray, place_key: PRNGKeyArray) -> Window:
        windows = source.draw(config.batch_size, draw_key)
        if split is not None:
            windows = split.shard(windows)
        for distractor_key in jax.random.split(place_key, distractors):
            windows = add_distractor(windows, nearest, 3.0 * nearest, distractor_key)
        return windows

    objective = objective_of(state.model)
    if not objective.rolls_out:
        with_rollout = None

    def loss(
        params: ContactDynamics, windows: Window, key: PRNGKeyArray
    ) -> tuple[Array, LossTerms]:
        model = eqx.combine(params, static)
        terms = objective.terms(model, windows, source, key, devices)
        return terms.total(config.weights), terms

    def rolled_out(params: ContactDynamics, windows: Window) -> Array:
        return rollout_loss(eqx.combine(params, static), windows, devices)

    def nothing(params: ContactDynamics, windows: Window) -> tuple[Array, ContactDynamics]:
        return jnp.zeros(()), jax.tree.map(jnp.zeros_like, params)

    Carry = tuple[ContactDynamics, optax.OptState, PRNGKeyArray]

    def step(carry: Carry, _: None) -> tuple[Carry, LossTerms]:
        params, optimiser_state, key = carry
        key, step_key = jax.random.split(key)
        draw_key, place_key, sample_key = jax.random.split(step_key, 3)
        windows = drawn(draw_key, place_key)
        (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(params, windows, sample_key)
        if with_rollout is not None:
            rollout, slope = jax.lax.cond(
                with_rollout, jax.value_and_grad(rolled_out), nothing, params, windows
            )
            terms = dataclasses.replace(terms, rollout=rollout)
            gradient = jax.tree.map(
                lambda one, other: one + config.weights.rollout * other, gradient, slope
            )
        updates, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        params = with_positive_distance(optax.apply_updates(params, updates))
        return (params, optimiser_state, key), terms

    key = jax.random.wrap_key_data(state.key)
    carry, terms = jax.lax.scan(step, (params, state.optimiser, key), length=count)
    params, optimiser_state, key = carry
    after = dataclasses.replace(
        state,
        model=eqx.combine(params, static),
        optimiser=optimiser_state,
        key=jax.random.key_data(key),
        step=state.step + count,
    )
    error = rollout_rmse(after.model, checked)
    counts = True if with_rollout is None else jnp.asarray(with_rollout)
    after = scored(after, error, error < state.best_error, counts)
    if split is not None:  # the sharding of the argument, else the next call would recompile
        after = split.replicate(after)
    return after, {**vars(jax.tree.map(jnp.mean, terms)), "held_out": error}
