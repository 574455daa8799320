"""Expectation maximisation: the motion is judged, then dynamics and filter learn from that.

The E-step draws whole trajectories and judges what their motion says of every edge. In the M-step
the dynamics learn from windows of them with the likeliest types, and in the second half of training
the filter learns from the likelihoods: what untrained dynamics call evidence teaches that nothing
ever holds. Each part is a program of its own, since programs compile in more than proportion to
their size, and the held-out trajectories are judged by the program of the others.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.advance import in_lengths, optimiser_of, scored, with_positive_distance
from contactgraph.train.batch import BatchSplit, Window, WindowSource
from contactgraph.train.config import TrainConfig
from contactgraph.train.filter_loss import DENIAL, dynamics_loss, filter_loss
from contactgraph.train.fit_state import FitState
from contactgraph.train.held_out import HeldOutWindows, rollout_rmse
from contactgraph.train.judged_steps import (
    JudgedSteps,
    JudgedTrajectories,
    judge_steps,
    observed_at_times,
    with_window_masses,
)
from contactgraph.train.loss import LossTerms

_PERIOD, _FILTER_STEPS = 25, 100
"""Steps of the dynamics on the same judged trajectories, and those of the filter that follow: it
learns from rare events, so it needs more steps, and each costs little."""
_JUDGED, _MOST, _LEAST = 6400, 32, 8
"""About as many steps are judged at once, of so many trajectories."""


def judged_count(steps: int, devices: int) -> int:
    """How many trajectories of so many steps are judged at once, a multiple of ``devices``."""
    count = max(_LEAST, min(_MOST, _JUDGED // steps))
    return count + -count % devices


def first_filter_optimiser_state(model: ContactDynamics, config: TrainConfig) -> PyTree:
    """Of Adam for the filter."""
    return _filter_optimiser(config).init(eqx.filter(model.inference, eqx.is_inexact_array))


def _filter_optimiser(config: TrainConfig) -> optax.GradientTransformation:
    return optimiser_of(config, max(1, config.steps // (2 * _PERIOD)) * _FILTER_STEPS)


def advance_filter(
    state: FitState,
    source: WindowSource,
    checked: HeldOutWindows,
    config: TrainConfig,
    count: int,
    with_rollout: Bool[np.ndarray, ""] | None,
    split: BatchSplit | None,
) -> tuple[FitState, dict[str, Array]]:
    """``count`` optimiser steps of the dynamics and those of the filter, then the held-out error.

    ``with_rollout``: see `advance_steps`.
    """
    length = _PERIOD if count % _PERIOD == 0 else count
    devices = 1 if split is None else split.mesh.size
    drawn = judged_count(source.weight.shape[1], devices)
    periods = []
    for _ in range(count // length):
        state, every, keys = _draw(state, source, drawn)
        states = every.states if split is None else split.shard(every.states)
        given = JudgedTrajectories(every, _judge(state.model, states, devices))
        learns = state, given, keys[0], config, length, source.length, with_rollout, split
        state, terms = _learn_dynamics(*learns)
        if 2 * int(state.step) > config.steps:
            touch = source.reports_touch
            state, score = _learn_filter(state, given, keys[1], config, touch)
            terms = dataclasses.replace(terms, likelihood=score)
        periods.append(terms)
    assert checked.every is not None
    judged = _judge(state.model, checked.every, devices)
    means = jax.tree.map(lambda *each: jnp.mean(jnp.stack(each)), *periods)
    settled = 4 * state.step > 3 * config.steps
    first = settled & (4 * (state.step - count) <= 3 * config.steps)
    counts = settled if with_rollout is None else settled & jnp.asarray(with_rollout)
    state, error = _score(state, checked, judged, first, counts)
    if split is not None:  # the sharding of the argument, else the next call would recompile
        state = split.replicate(state)
    return state, {**vars(means), "held_out": error}


@eqx.filter_jit
def _draw(state: FitState, source: WindowSource, count: int) -> tuple:
    """The state with its next key, whole trajectories, and two keys."""
    key, draw_key, *keys = jax.random.split(jax.random.wrap_key_data(state.key), 4)
    state = dataclasses.replace(state, key=jax.random.key_data(key))
    return state, source.draw_trajectories(count, draw_key), keys


_judge = eqx.filter_jit(judge_steps)


@eqx.filter_jit
def _learn_dynamics(
    state: FitState,
    given: JudgedTrajectories,
    key: PRNGKeyArray,
    config: TrainConfig,
    count: int,
    length: int,
    with_rollout: Bool[np.ndarray, ""] | None,
    split: BatchSplit | None,
) -> tuple[FitState, LossTerms]:
    """``count`` steps on windows of ``length`` steps; the filter does not learn."""
    optimiser = optimiser_of(config)
    params, static = eqx.partition(state.model, eqx.is_inexact_array)
    # A half of the windows is predicted from their first states, as soon as that counts.
    rolled_out = jnp.arange(config.batch_size) % 2 == 1
    rolled_out &= False if with_rollout is None else jnp.asarray(with_rollout)

    def loss(params: PyTree, windows: Window, judged: JudgedSteps) -> tuple[Array, LossTerms]:
        terms = dynamics_loss(eqx.combine(params, static), windows, judged, rolled_out)
        return terms.total(config.weights), terms

    Carry = tuple[PyTree, optax.OptState]

    def step(carry: Carry, key: PRNGKeyArray) -> tuple[Carry, LossTerms]:
        params, optimiser_state = carry
        drawn = given.windows(config.batch_size, length, key)
        windows, judged = drawn if split is None else split.shard(drawn)
        windows = with_window_masses(windows, judged.masses)
        (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(params, windows, judged)
        updates, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        params = with_positive_distance(optax.apply_updates(params, in_lengths(updates)))
        return (params, optimiser_state), terms

    of_dynamics, of_filter = state.optimiser
    keys = jax.random.split(key, count)
    (params, of_dynamics), terms = jax.lax.scan(step, (params, of_dynamics), keys)
    learned = dataclasses.replace(
        state,
        model=eqx.combine(params, static),
        optimiser=(of_dynamics, of_filter),
        step=state.step + count,
    )
    return learned, jax.tree.map(jnp.mean, terms)


@eqx.filter_jit
def _learn_filter(
    state: FitState,
    given: JudgedTrajectories,
    key: PRNGKeyArray,
    config: TrainConfig,
    reports_touch: bool,
) -> tuple[FitState, Float[Array, ""]]:
    """Steps of the filter alone, and their mean score."""
    optimiser, (hide_key, key) = _filter_optimiser(config), jax.random.split(key)
    model, (of_dynamics, of_filter) = state.model, state.optimiser
    pool = observed_at_times(model, given, hide_key)
    params, static = eqx.partition(model.inference, eqx.is_inexact_array)

    def loss(params: PyTree, key: PRNGKeyArray) -> Float[Array, ""]:
        learned = dataclasses.replace(model, inference=eqx.combine(params, static))
        draw_key, key = jax.random.split(key)
        drawn = pool.draw(draw_key)
        every = drawn.given.every
        steps = every.states, drawn.given.judged, every.real, drawn.observed
        reported = every.contact, reports_touch, DENIAL
        return config.weights.likelihood * filter_loss(learned, *steps, key, *reported)

    Carry = tuple[PyTree, optax.OptState]

    def step(carry: Carry, key: PRNGKeyArray) -> tuple[Carry, Array]:
        params, optimiser_state = carry
        score, gradient = jax.value_and_grad(loss)(params, key)
        updates, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, updates), optimiser_state), score

    keys = jax.random.split(key, _FILTER_STEPS)
    (params, of_filter), score = jax.lax.scan(step, (params, of_filter), keys)
    learned = dataclasses.replace(model, inference=eqx.combine(params, static))
    state = dataclasses.replace(state, model=learned, optimiser=(of_dynamics, of_filter))
    return state, jnp.mean(score)


@eqx.filter_jit
def _score(
    state: FitState,
    checked: HeldOutWindows,
    judged: JudgedSteps,
    first: Bool[Array, ""],
    counts: Bool[Array, ""],
) -> tuple[FitState, Float[Array, ""]]:
    """The state with the better model, and the held-out error: see `scored`.

    Where geometry tells the contact, rollouts do not tell a filter that has hardly learned; so the
    ``first`` model of the last quarter of the steps is better than all before.
    """
    error = rollout_rmse(state.model, checked, judged)
    return scored(state, error, first | (error < state.best_error), counts), error
