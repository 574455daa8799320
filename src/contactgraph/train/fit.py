"""The training loop: it advances by many optimiser steps, and checks the held-out error."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from contactgraph.data.dataset import Dataset, near_origin, with_edge_labels
from contactgraph.data.trajectory_batch import TrajectoryBatch, pad_trajectories
from contactgraph.data.windows import window_weights
from contactgraph.large_scenes.neighbor_list import ReallocatingModel
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.advance import advance_steps, optimiser_of
from contactgraph.train.batch import (
    WindowSource,
    batch_split,
    has_resting_bodies,
    window_source,
)
from contactgraph.train.config import TrainConfig
from contactgraph.train.expectation_maximisation import (
    advance_filter,
    first_filter_optimiser_state,
    judged_count,
)
from contactgraph.train.filter_loss import check_contacts
from contactgraph.train.fit_state import FitProgress, FitResult, FitState, FitStatus, with_lists
from contactgraph.train.held_out import (
    equals_constant_velocity,
    has_dead_units,
    held_out_windows,
    rollout_rmse,
)
from contactgraph.train.identification import identifies_laws, identify_laws
from contactgraph.train.loss import objective_of

_BURN = 20
"""Steps that correct a filter before a held-out window."""


def initial_state(model: ContactDynamics, config: TrainConfig, seed: int) -> FitState:
    """The state before the first step; equal seeds give equal results."""
    optimiser: PyTree = optimiser_of(config).init(eqx.filter(model, eqx.is_inexact_array))
    if model.prediction_noise is not None:
        optimiser = optimiser, first_filter_optimiser_state(model, config)
    return FitState(
        model=model,
        optimiser=optimiser,
        key=jax.random.key_data(jax.random.key(seed)),
        # Explicit types: a weakly typed first state would compile all of training twice.
        step=jnp.zeros((), int),
        best_model=model,
        best_error=jnp.full((), jnp.inf, float),
        checks_without_gain=jnp.zeros((), int),
    )


def fit(
    state: FitState,
    train: Dataset,
    held_out: Dataset,
    config: TrainConfig,
    on_check: Callable[[FitProgress], None] = lambda progress: None,
    devices: Sequence[jax.Device] = (),
) -> FitResult:
    """Train from `state` to the last step of `config`, or until the held-out error stops falling.

    A dead network ends the training, too: see `has_dead_units` and `equals_constant_velocity`.
    Large scenes are trained with neighbor lists: see `ReallocatingModel`. Contact labels in the
    data are read with `config.use_contacts` alone: see `filter_loss`. `on_check` is called at every
    check and may save its state; an exception from it (as Ctrl-C does) ends the training. Each of
    several `devices` takes an equal part of every batch, with the same result up to rounding.
    Raises `InvalidInputError` where trajectories are shorter than a window, a batch cannot be
    split, or contacts cannot be used.
    """
    began = time.monotonic()
    split = batch_split(devices, config.batch_size)
    if config.use_contacts:
        check_contacts(state.model, train, "training with contacts")
    train, held_out = near_origin(train), near_origin(held_out)
    labelled = with_edge_labels(train) if config.use_contacts else train
    turn_length, model = state.model.features.turn_length, state.model
    filtered, judged, most = model.prediction_noise is not None, 0, None
    if filtered:  # Both parts are judged by one program.
        most = max(each.steps for each in (*train, *held_out))
        judged = judged_count(most, max(1, len(devices)))
        held_out = dataclasses.replace(held_out, trajectories=held_out.trajectories[:judged])
    padded = partial(pad_trajectories, steps=most, turn_length=turn_length)
    batch = padded(labelled, contacts=config.use_contacts)
    source = _window_source(batch, config)
    source = dataclasses.replace(source, reports_touch=labelled is train)
    other, shortest = padded(held_out, contacts=False), min(each.steps for each in held_out)
    burn = _BURN if filtered else objective_of(model).burn
    burn = max(int(filtered), min(burn, shortest - config.window_length))
    checking = dataclasses.replace(config, window_length=config.window_length + burn)
    checked = held_out_windows(_window_source(other, checking), burn, judged)
    baselines = checked.baselines(train.dt)
    if split is not None:
        state, source, checked = split.replicate((state, source, checked))
    distractors = config.bystanders if has_resting_bodies(batch) else 0
    lists = ReallocatingModel(state.model, train)

    def advance(state: FitState, count: int) -> tuple[FitState, dict[str, Array]]:
        if identifies_laws(state.model):
            model = identify_laws(state.model, batch)
            error = eqx.filter_jit(rollout_rmse)(model, checked)
            found = dataclasses.replace(state, model=model, best_model=model, best_error=error)
            return dataclasses.replace(found, step=state.step + count), {"held_out": error}
        with_rollout = None
        if config.rollout_from < 1.0:
            with_rollout = np.asarray(int(state.step) >= config.rollout_from * config.steps)

        def further(model: ContactDynamics) -> tuple[FitState, dict[str, Array]]:
            given = with_lists(state, model.neighbor_list), source, checked, config, count
            if filtered:
                return advance_filter(*given, with_rollout, split)
            return advance_steps(*given, distractors, with_rollout, split)

        after, arrays = lists.reallocate_on_overflow(further, lambda found: _finite(found[1]))
        return with_lists(after, lists.given.neighbor_list), arrays

    status = FitStatus.finished
    while int(state.step) < config.steps:
        if int(state.checks_without_gain) >= config.patience:
            status = FitStatus.stopped_early
            break
        left = config.steps - int(state.step)
        count = left if identifies_laws(state.model) else min(config.check_every, left)
        state, arrays = advance(state, count)
        terms = {name: float(value) for name, value in arrays.items()}
        if not _finite(arrays):
            status = FitStatus.not_finite
            break
        on_check(
            FitProgress(
                step=int(state.step),
                steps=config.steps,
                terms={name: terms[name] for name in terms if name != "held_out"},
                held_out_rmse_m=terms["held_out"],
                seconds=time.monotonic() - began,
                state=state,
                baselines=baselines,
            )
        )
        if not identifies_laws(state.model) and has_dead_units(state.model, checked.windows):
            status = FitStatus.dead_units
            break
        best, done = float(state.best_error), int(state.step) / config.steps
        if equals_constant_velocity(terms["held_out"], best, baselines, done):
            status = FitStatus.constant_velocity
            break
    seconds = time.monotonic() - began
    best = float(state.best_error)
    return FitResult(state.best_model, best, status, state, seconds, baselines)


def _finite(terms: dict[str, Array]) -> bool:
    return all(np.isfinite(value) for value in terms.values())


def _window_source(batch: TrajectoryBatch[np.ndarray], config: TrainConfig) -> WindowSource:
    windows = window_weights(batch, config.window_length, config.event_fraction)
    return window_source(batch, windows, batch.contact is not None)
