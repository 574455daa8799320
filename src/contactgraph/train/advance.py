"""Many optimiser steps in one compiled call, then the held-out error."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import TransitionEdges
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.motion_likelihood import TrajectoryModel
from contactgraph.train.batch import BatchSplit, Window, WindowSource, add_distractor
from contactgraph.train.config import TrainConfig
from contactgraph.train.filter_loss import (
    DENIAL,
    dynamics_loss,
    filter_loss,
    given_rollout_loss,
)
from contactgraph.train.fit_state import FitState
from contactgraph.train.held_out import HeldOutWindows, rollout_rmse
from contactgraph.train.judged_steps import (
    JudgedSteps,
    judge_steps,
    judge_trajectories,
    with_window_masses,
)
from contactgraph.train.loss import LossTerms, rollout_loss, window_loss

_PERIOD, _FILTER_STEPS = 25, 100
"""Steps of the dynamics, and those of the filter that follow on newly judged trajectories in the
second half of training: what untrained dynamics call evidence teaches that nothing ever holds."""
_CLEARANCE = 1.03
"""Least distance of a distractor, in learned contact distances."""
_SHORTEST = 0.1
"""Least learned contact distance, in first guesses."""


def first_optimiser_state(model: ContactDynamics, config: TrainConfig) -> PyTree:
    """Of Adam; where the inference is a filter, of another Adam for the filter, too."""
    params = eqx.filter(model, eqx.is_inexact_array)
    state = _optimiser(config).init(params)
    if not isinstance(model.inference, TransitionEdges):
        return state
    return state, _filter_optimiser(config).init(params.inference)


def _optimiser(config: TrainConfig, steps: int | None = None) -> optax.GradientTransformation:
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


def _filter_optimiser(config: TrainConfig) -> optax.GradientTransformation:
    return _optimiser(config, max(1, config.steps // (2 * _PERIOD)) * _FILTER_STEPS)


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


def _learn_filter(
    model: ContactDynamics,
    optimiser_state: optax.OptState,
    key: PRNGKeyArray,
    source: WindowSource,
    config: TrainConfig,
) -> tuple[ContactDynamics, optax.OptState, Float[Array, ""]]:
    """The model after steps of its filter alone, and their mean score.

    The filter learns from rare events, so it needs more steps than the dynamics, and each costs
    little where the motion has been judged.
    """
    optimiser, (draw_key, key) = _filter_optimiser(config), jax.random.split(key)
    pool = judge_trajectories(model, source, draw_key)
    params, static = eqx.partition(model.inference, eqx.is_inexact_array)

    def loss(params: PyTree, key: PRNGKeyArray) -> Float[Array, ""]:
        learned = dataclasses.replace(model, inference=eqx.combine(params, static))
        draw_key, key = jax.random.split(key)
        drawn = pool.draw(draw_key)
        given = drawn.trajectories, drawn.judged, drawn.step_mask, drawn.observed
        reported = drawn.contact, source.reports_touch, DENIAL
        return config.weights.likelihood * filter_loss(learned, *given, key, *reported)

    def step(
        carry: tuple[PyTree, optax.OptState], key: PRNGKeyArray
    ) -> tuple[tuple[PyTree, optax.OptState], Array]:
        params, state = carry
        score, gradient = jax.value_and_grad(loss)(params, key)
        updates, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), score

    keys = jax.random.split(key, _FILTER_STEPS)
    carry, score = jax.lax.scan(step, (params, optimiser_state), keys)
    params, optimiser_state = carry
    learned = dataclasses.replace(model, inference=eqx.combine(params, static))
    return learned, optimiser_state, jnp.mean(score)


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
    optimiser = _optimiser(config)
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

    filtered = isinstance(state.model.inference, TransitionEdges)
    if isinstance(state.model, TrajectoryModel):
        with_rollout = None  # It is learned along whole trajectories.

    def loss(
        params: ContactDynamics,
        windows: Window,
        judged: JudgedSteps | None,
        key: PRNGKeyArray,
    ) -> tuple[Array, LossTerms]:
        model = eqx.combine(params, static)
        if isinstance(model, TrajectoryModel):
            every, real, _ = source.draw_trajectories(config.batch_size, key)
            score = jnp.mean(jax.vmap(model.trajectory_loss)(every.trajectories(real)))
            zero = jnp.zeros(())
            terms = LossTerms(zero, zero, zero, zero, likelihood=score, noise=zero)
        elif judged is None:
            terms = window_loss(model, windows, key, False, devices)
        else:
            terms = dynamics_loss(model, windows, judged, devices)
        return terms.total(config.weights), terms

    def rolled_out(params: ContactDynamics, windows: Window, judged: JudgedSteps | None) -> Array:
        model = eqx.combine(params, static)
        if judged is not None:
            return given_rollout_loss(model, windows, judged)
        return rollout_loss(model, windows, devices)

    def nothing(
        params: ContactDynamics, windows: Window, judged: JudgedSteps | None
    ) -> tuple[Array, ContactDynamics]:
        return jnp.zeros(()), jax.tree.map(jnp.zeros_like, params)

    Carry = tuple[ContactDynamics, optax.OptState, PRNGKeyArray]

    def step(carry: Carry, _: None) -> tuple[Carry, LossTerms]:
        params, optimiser_state, key = carry
        key, step_key = jax.random.split(key)
        draw_key, place_key, sample_key = jax.random.split(step_key, 3)
        windows = drawn(draw_key, place_key)
        judged = None
        if filtered:
            judged = judge_steps(eqx.combine(params, static), windows, devices)
            windows = with_window_masses(windows, judged.masses)
        given = windows, judged
        (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(params, *given, sample_key)
        if with_rollout is not None:
            rollout, slope = jax.lax.cond(
                with_rollout, jax.value_and_grad(rolled_out), nothing, params, *given
            )
            terms = dataclasses.replace(terms, rollout=rollout)
            gradient = jax.tree.map(
                lambda one, other: one + config.weights.rollout * other, gradient, slope
            )
        updates, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        updates = in_lengths(updates) if filtered else updates
        params = with_positive_distance(optax.apply_updates(params, updates))
        return (params, optimiser_state, key), terms

    key = jax.random.wrap_key_data(state.key)
    if filtered:
        length = _PERIOD if count % _PERIOD == 0 else count
        learn = partial(_learn_filter, source=source, config=config)
        Both = tuple[ContactDynamics, tuple[optax.OptState, optax.OptState], PRNGKeyArray]

        def period(carry: Both, done: Array) -> tuple[Both, LossTerms]:
            params, (optimiser_state, filter_state), key = carry
            (params, optimiser_state, key), terms = jax.lax.scan(
                step, (params, optimiser_state, key), length=length
            )
            key, filter_key = jax.random.split(key)

            def filter_learned(params: ContactDynamics) -> tuple:
                model = eqx.combine(params, static)
                model, state, score = learn(model, filter_state, filter_key)
                return eqx.filter(model, eqx.is_inexact_array), state, score

            params, filter_state, score = jax.lax.cond(
                2 * done > config.steps,
                filter_learned,
                lambda params: (params, filter_state, jnp.zeros(())),
                params,
            )
            terms = dataclasses.replace(terms, likelihood=jnp.full(length, score))
            return (params, (optimiser_state, filter_state), key), terms

        first = params, state.optimiser, key
        done = state.step + length * (1 + jnp.arange(count // length))
        carry, terms = jax.lax.scan(period, first, done)
    else:
        carry, terms = jax.lax.scan(step, (params, state.optimiser, key), length=count)
    params, optimiser_state, key = carry
    model = eqx.combine(params, static)
    error = rollout_rmse(model, checked)
    # Where geometry tells the contact, rollouts do not tell a filter that has hardly learned.
    settled = jnp.asarray(not filtered) | (4 * (state.step + count) > 3 * config.steps)
    first_settled = filtered & settled & (4 * state.step <= 3 * config.steps)
    better = first_settled | (error < state.best_error)
    # The error is of rollouts, which the loss may not hold yet.
    waits = ~settled if with_rollout is None else ~(settled & with_rollout)
    best = jax.tree.map(
        lambda new, old: jnp.where(better, new, old) if eqx.is_array(new) else new,
        model,
        state.best_model,
    )
    means = jax.tree.map(jnp.mean, terms)
    state = FitState(
        model=model,
        optimiser=optimiser_state,
        key=jax.random.key_data(key),
        step=state.step + count,
        best_model=best,
        best_error=jnp.where(better, error, state.best_error),
        checks_without_gain=jnp.where(better | waits, 0, state.checks_without_gain + 1),
    )
    if split is not None:  # the sharding of the argument, else the next call would recompile
        state = split.replicate(state)
    return state, {**{name: getattr(means, name) for name in _TERM_NAMES}, "held_out": error}


_TERM_NAMES = tuple(field.name for field in dataclasses.fields(LossTerms))
