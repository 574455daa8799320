"""The training loop: many optimiser steps in one compiled call, then a held-out check."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, PRNGKeyArray

from contactgraph.data.dataset import Dataset, with_edge_labels
from contactgraph.data.trajectory_batch import TrajectoryBatch, pad_trajectories
from contactgraph.data.windows import window_weights
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import TransitionEdges
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.neighbor_allocation import ReallocatingModel
from contactgraph.model.neighbor_list import NeighborList
from contactgraph.train.batch import (
    BatchSplit,
    Window,
    WindowSource,
    add_distractor,
    batch_split,
    has_resting_bodies,
    static_bodies,
    window_source,
)
from contactgraph.train.config import TrainConfig
from contactgraph.train.contact_reports import check_contacts
from contactgraph.train.dead_network import equals_constant_velocity, has_dead_units
from contactgraph.train.filter_loss import DENIAL, dynamics_loss, filter_loss
from contactgraph.train.fit_state import FitProgress, FitResult, FitState, FitStatus
from contactgraph.train.held_out import HeldOutWindows, held_out_windows, rollout_rmse
from contactgraph.train.loss import LossTerms, rollout_loss, window_loss

_FILTERED = 8
"""Whole trajectories a step on which a filter is scored."""
_BURN = 20
"""Steps that correct a filter before a held-out window."""
_CLEARANCE = 1.03
"""Least distance of a distractor, in learned contact distances."""
_SHORTEST = 0.1
"""Least learned contact distance, in first guesses."""


def initial_state(model: ContactDynamics, config: TrainConfig, seed: int) -> FitState:
    """The state before the first step; equal seeds give equal results."""
    return FitState(
        model=model,
        optimiser=_optimiser(config).init(eqx.filter(model, eqx.is_inexact_array)),
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
    labelled = with_edge_labels(train) if config.use_contacts else train
    batch = pad_trajectories(labelled, contacts=config.use_contacts)
    static = static_bodies(train, batch.nodes.mask.shape[1])
    source = _window_source(batch, config, static)
    source = dataclasses.replace(source, reports_touch=labelled is train)
    other = pad_trajectories(held_out, contacts=False)
    still = static_bodies(held_out, other.nodes.mask.shape[1])
    burn = 0
    if isinstance(state.model.inference, TransitionEdges):
        burn = max(0, min(_BURN, min(each.steps for each in held_out) - config.window_length))
    checking = dataclasses.replace(config, window_length=config.window_length + burn)
    checked = held_out_windows(_window_source(other, checking, still), burn)
    baselines = checked.baselines(train.dt)
    if split is not None:
        state, source, checked = split.replicate((state, source, checked))
    distractors = config.bystanders if has_resting_bodies(batch, static) else 0
    lists = ReallocatingModel(state.model, train)

    def advance(state: FitState, count: int) -> tuple[FitState, dict[str, Array]]:
        with_rollout = None
        if config.rollout_from < 1.0:
            with_rollout = np.asarray(int(state.step) >= config.rollout_from * config.steps)
        after, arrays = lists.reallocate_on_overflow(
            lambda model: _advance(
                _with_lists(state, model.neighbor_list),
                *(source, checked, config, count, distractors, with_rollout, split),
            ),
            lambda found: _finite(found[1]),
        )
        return _with_lists(after, lists.given.neighbor_list), arrays

    status = FitStatus.finished
    while int(state.step) < config.steps:
        if int(state.checks_without_gain) >= config.patience:
            status = FitStatus.stopped_early
            break
        count = min(config.check_every, config.steps - int(state.step))
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
        if has_dead_units(state.model, checked.windows):
            status = FitStatus.dead_units
            break
        best, done = float(state.best_error), int(state.step) / config.steps
        if equals_constant_velocity(terms["held_out"], best, baselines, done):
            status = FitStatus.constant_velocity
            break
    seconds = time.monotonic() - began
    best = float(state.best_error)
    return FitResult(state.best_model, best, status, state, seconds, baselines)


def _with_lists(state: FitState, lists: NeighborList | None) -> FitState:
    """The state with these lists in the models, and in the averages that mirror them."""

    def is_model(part: object) -> bool:
        return isinstance(part, ContactDynamics)

    return jax.tree.map(
        lambda part: dataclasses.replace(part, neighbor_list=lists) if is_model(part) else part,
        state,
        is_leaf=is_model,
    )


def _finite(terms: dict[str, Array]) -> bool:
    return all(np.isfinite(value) for value in terms.values())


def _window_source(
    batch: TrajectoryBatch[np.ndarray], config: TrainConfig, static: np.ndarray | None
) -> WindowSource:
    windows = window_weights(batch, config.window_length, config.event_fraction)
    return window_source(batch, windows, static, batch.contact is not None)


def _optimiser(config: TrainConfig) -> optax.GradientTransformation:
    rate = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=min(100, config.steps),
        decay_steps=max(config.steps, min(100, config.steps) + 1),
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


@eqx.filter_jit
def _advance(
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

    def loss(
        params: ContactDynamics, windows: Window, key: PRNGKeyArray
    ) -> tuple[Array, LossTerms]:
        model = eqx.combine(params, static)
        if filtered:
            draw_key, key = jax.random.split(key)
            terms = dynamics_loss(model, windows, False, devices)
            whole, step_mask, contact = source.draw_trajectories(_FILTERED, draw_key)
            given = contact, source.reports_touch, DENIAL
            likelihood = filter_loss(model, whole, step_mask, key, *given)
            terms = dataclasses.replace(terms, likelihood=likelihood)
        else:
            terms = window_loss(model, windows, key, False, devices)
        return terms.total(config.weights), terms

    def rolled_out(params: ContactDynamics, windows: Window) -> Array:
        model = eqx.combine(params, static)
        if filtered:
            return jnp.asarray(dynamics_loss(model, windows, True, devices).rollout)
        return rollout_loss(model, windows, devices)

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

    carry = (params, state.optimiser, jax.random.wrap_key_data(state.key))
    (params, optimiser_state, key), terms = jax.lax.scan(step, carry, length=count)
    model = eqx.combine(params, static)
    error = rollout_rmse(model, checked)
    better = error < state.best_error
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
        checks_without_gain=jnp.where(better, 0, state.checks_without_gain + 1),
    )
    if split is not None:  # the sharding of the argument, else the next call would recompile
        state = split.replicate(state)
    return state, {**{name: getattr(means, name) for name in _TERM_NAMES}, "held_out": error}


_TERM_NAMES = tuple(field.name for field in dataclasses.fields(LossTerms))
