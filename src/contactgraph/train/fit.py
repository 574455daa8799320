"""The training loop: it advances by many optimiser steps, and checks the held-out error."""

import enum
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.data.dataset import Dataset, near_origin, with_edge_labels
from contactgraph.data.padding import pad_trajectories
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import batch_split, has_resting_bodies, window_source
from contactgraph.train.expectation_maximisation import ExpectationMaximisation
from contactgraph.train.held_out import (
    HeldOutBaselines,
    equals_constant_velocity,
    has_dead_units,
    held_out_windows,
    rollout_rmse,
)
from contactgraph.train.identification import (
    LawIdentification,
    check_contacts,
    identifies_laws,
)
from contactgraph.train.objective import FitState, Objective, TrainConfig, TrainingData
from contactgraph.train.window_loss import WindowObjective

_TIE = 1e-3
"""Relative difference of errors up to which neither is better."""
_Result = TypeVar("_Result")
_rollout_rmse = eqx.filter_jit(rollout_rmse)


class FitStatus(enum.Enum):
    """The end of training; the value is the text for users."""

    finished = "all steps done"
    stopped_early = "the held-out error no longer fell"
    not_finite = "the loss became infinite or not a number; a lower learning rate may help"
    dead_units = "the network is dead: its messages are the same for every pair of bodies"
    constant_velocity = "the network is dead: its error equals that of constant velocity"


@dataclass(frozen=True)
class FitProgress:
    """The state of training at one check."""

    step: int
    steps: int
    terms: dict[str, float]
    """Loss terms by name, means since the last check."""
    held_out_rmse_m: float
    """Position error of the bodies that move, over windows of held-out trajectories that are
    predicted from their first states, at this check."""
    seconds: float
    """Since this call of `fit` began, compilation included."""
    state: FitState
    baselines: HeldOutBaselines


@dataclass(frozen=True)
class FitResult:
    """The model with the least error on the held-out trajectories."""

    model: ContactDynamics
    held_out_rmse_m: float
    status: FitStatus
    state: FitState
    seconds: float
    """Of this call of `fit`, compilation included."""
    baselines: HeldOutBaselines

    def __repr__(self) -> str:
        baseline = f"constant velocity {self.baselines.constant_velocity_rmse_m:.4g} m"
        error = f"held-out error {self.held_out_rmse_m:.4g} m, {baseline}"
        return f"FitResult({self.status.value}, {error}, {self.seconds:.0f} s)"

    @property
    def is_better(self) -> bool:
        """Whether the model predicts better than constant velocity and than standing still.

        Errors that differ by less than 0.1 % are equal.
        """
        baselines = self.baselines
        least = min(baselines.constant_velocity_rmse_m, baselines.standing_still_rmse_m)
        return self.held_out_rmse_m < (1.0 - _TIE) * least


class NearPairs(Protocol):
    """Lists of near pairs for a model, such as `ReallocatingModel`."""

    def reallocate_on_overflow(
        self, predict: Callable[[ContactDynamics], _Result], finite: Callable[[_Result], bool]
    ) -> _Result:
        """The result for the model with a list; where it is not ``finite``, for a longer one."""


def objective_of(model: ContactDynamics) -> Objective:
    """The model's own objective, else that of its form."""
    own: Objective | None = getattr(model, "objective", None)
    if own:
        return own
    if identifies_laws(model):
        return LawIdentification()
    return WindowObjective() if model.prediction_noise is None else ExpectationMaximisation()


def initial_state(model: ContactDynamics, config: TrainConfig, seed: int) -> FitState:
    """The state before the first step; equal seeds give equal results."""
    return FitState(
        model=model,
        optimiser=objective_of(model).optimiser_state(model, config),
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
    near_pairs: Callable[[ContactDynamics, Dataset], NearPairs] | None = None,
) -> FitResult:
    """Train from `state` to the last step of `config`, or until the held-out error stops falling.

    A dead network ends the training, too: see `has_dead_units` and `equals_constant_velocity`.
    Contact labels in the data are read with `config.use_contacts` alone: see `motion_evidence`.
    `on_check` is called at every check and may save its state; an exception from it (as Ctrl-C
    does) ends the training. Each of several `devices` takes an equal part of every batch, with the
    same result up to rounding. With `near_pairs=ReallocatingModel` large scenes are trained with
    neighbor lists, but for a filter, which is judged on all pairs. Raises `InvalidInputError` where
    trajectories are shorter than a window, a batch cannot be split, or contacts cannot be used.
    """
    began, objective = time.monotonic(), objective_of(state.model)
    train, held_out = near_origin(train), near_origin(held_out)
    data = training_data(state.model, objective, train, held_out, config, devices)
    checked, split = data.held_out, data.split
    baselines = checked.baselines(train.dt)
    lists = near_pairs(state.model, train) if near_pairs and objective.near_pairs else None
    state = split.replicate(state)

    def advance(count: int, model: ContactDynamics) -> tuple[FitState, dict[str, Array], Array]:
        after, terms = objective.advance(state, data, count, model.neighbor_list)
        listed = replace(after.model, neighbor_list=model.neighbor_list)
        belief, windows = objective.first_beliefs(listed, checked, split.parts)
        return after, terms, _rollout_rmse(listed, windows, belief, checked.counted)

    def finite(result: tuple[FitState, dict[str, Array], Array]) -> bool:
        _, terms, error = result
        return all(np.isfinite(value) for value in (*terms.values(), error))

    status = FitStatus.finished
    while int(state.step) < config.steps:
        if int(state.checks_without_gain) >= config.patience:
            status = FitStatus.stopped_early
            break
        count = config.steps - int(state.step)
        count = min(config.check_every, count) if objective.stepwise else count
        step = partial(advance, count)
        result = lists.reallocate_on_overflow(step, finite) if lists else step(state.model)
        after, terms, error = result
        if not finite(result):
            state, status = after, FitStatus.not_finite
            break
        # The sharding of the argument, else the next call would recompile.
        state = split.replicate(scored(objective, config, state, after, error))
        on_check(
            FitProgress(
                step=int(state.step),
                steps=config.steps,
                terms={name: float(value) for name, value in terms.items()},
                held_out_rmse_m=float(error),
                seconds=time.monotonic() - began,
                state=state,
                baselines=baselines,
            )
        )
        if objective.stepwise and has_dead_units(state.model, checked.windows):
            status = FitStatus.dead_units
            break
        best, done = float(state.best_error), int(state.step) / config.steps
        if equals_constant_velocity(float(error), best, baselines, done):
            status = FitStatus.constant_velocity
            break
    seconds = time.monotonic() - began
    best = float(state.best_error)
    return FitResult(state.best_model, best, status, state, seconds, baselines)


def training_data(
    model: ContactDynamics,
    objective: Objective,
    train: Dataset,
    held_out: Dataset,
    config: TrainConfig,
    devices: Sequence[jax.Device],
) -> TrainingData:
    """Both parts, padded to the same steps, and windows of them; for what it raises see `fit`."""
    split = batch_split(devices, config.batch_size)
    if config.use_contacts:
        check_contacts(model, train, "training with contacts")
    labelled = with_edge_labels(train) if config.use_contacts else train
    steps = max(each.steps for each in (*train, *held_out))
    held_out = objective.checked(held_out, steps, split.parts)
    padded = partial(pad_trajectories, steps=steps, turn_length=model.features.turn_length)
    batch, other = padded(labelled, contacts=config.use_contacts), padded(held_out, contacts=False)
    length, fraction = config.window_length, config.event_fraction
    shortest = min(each.steps for each in held_out)
    burn = max(objective.least_burn, min(objective.burn, shortest - length))
    source, checked = split.replicate(
        (
            window_source(batch, length, fraction),
            held_out_windows(window_source(other, length + burn, fraction), burn),
        )
    )
    return TrainingData(
        config=config,
        batch=None if objective.stepwise else batch,
        source=source,
        held_out=checked,
        distractors=config.bystanders if has_resting_bodies(batch) else 0,
        reports_touch=labelled is train,
        split=split,
    )


def scored(
    objective: Objective, config: TrainConfig, before: FitState, after: FitState, error: Array
) -> FitState:
    """The state after a check: its model is the best one where its error is the least so far.

    A check without gain is one from which on errors are compared, and after the loss began to hold
    rollouts.
    """
    begins = objective.compared_from * config.steps
    better = bool(error < before.best_error) or before.step <= begins < after.step
    rollouts = objective.rolls_out and config.rollout_from < 1.0
    counts = after.step > begins and not (rollouts and before.step < config.first_rollout)
    in_vain = counts and not better
    return replace(
        after,
        best_model=after.model if better else before.best_model,
        best_error=error if better else before.best_error,
        checks_without_gain=(before.checks_without_gain + 1) * in_vain,
    )
