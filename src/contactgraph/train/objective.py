"""The interface between the training loop and what is minimised; numbers, state and optimiser."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from contactgraph.bodies.graph import EdgeList, edge_count
from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.train.batch import BatchSplit, WindowSource, chunked_vmap
from contactgraph.train.held_out import HeldOutWindows

_SHORTEST = 0.1
"""Least learned contact distance, in first guesses."""


class LossTerms(eqx.Module):
    """The terms of the loss, or their weights."""

    prediction: Float[Array, ""] | float = 1.0
    """Mean norm of the one-step error of a node's state, in units of velocity, m/s."""
    squared: Float[Array, ""] | float = 1.0
    """Mean square of the same, (m/s)^2; dominated by the rare large error, a missed impact."""
    rollout: Float[Array, ""] | float = 0.3
    """Mean norm of the error when a whole window is predicted from its first state, m/s."""
    prior: Float[Array, ""] | float = 0.05
    """Mean KL divergence of the belief from the distance prior, nat per edge."""
    likelihood: Float[Array, ""] | float = 1.0
    """Mean cross-entropy of a filter's transitions, nat per edge."""
    noise: Float[Array, ""] | float = 1.0
    """Mean score of the prediction noise: see `PredictionNoise`."""

    @classmethod
    def of(cls, **terms: Float[Array, ""]) -> "LossTerms":
        """These terms, and 0 for all others."""
        return cls(**{name: jnp.zeros(()) for name in cls.__dataclass_fields__} | terms)

    def total(self, weights: "LossTerms") -> Float[Array, ""]:
        """The weighted sum."""
        return jnp.asarray(sum(term * getattr(weights, name) for name, term in vars(self).items()))


@dataclass(frozen=True)
class TrainConfig:
    """Every number that shapes the result of a training.

    Raises `InvalidInputError` naming the first number that is out of range.
    """

    steps: int = 2000
    """Optimiser steps."""
    batch_size: int = 32
    """Windows a step."""
    window_length: int = 8
    """Steps of a window."""
    learning_rate: float = 3e-3
    """Highest rate of Adam; it rises over the first 100 steps and falls along a cosine."""
    event_fraction: float = 0.6
    """Share of windows that hold an impact."""
    rollout_from: float = 0.5
    """Part of the steps after which the rollout term joins the loss."""
    bystanders: int = 1
    """Resting distractors added to every window; none where the data never show a body at rest."""
    patience: int = 12
    """Checks of the held-out error without improvement after which training stops."""
    check_every: int = 125
    """Optimiser steps between checks."""
    use_contacts: bool = False
    """Whether recorded contacts are evidence of training, too, beside the motion."""
    weights: LossTerms = field(default_factory=LossTerms)
    """Weights of the terms of the loss."""

    def __post_init__(self) -> None:
        for name, (lowest, highest) in _BOUNDS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise InvalidInputError(f"{name} must be {lowest} to {highest}, found {value}")
        if not (self.learning_rate > 0 and math.isfinite(self.learning_rate)):
            raise InvalidInputError(
                f"learning_rate must be positive and finite, found {self.learning_rate}"
            )

    @property
    def first_rollout(self) -> int:
        """The step from which on the rollout term is in the loss."""
        return math.ceil(self.rollout_from * self.steps)


_BOUNDS = {
    "steps": (1, 10**9),
    "batch_size": (1, 65536),
    "window_length": (1, 10**6),
    "event_fraction": (0, 1),
    "rollout_from": (0, 1),
    "bystanders": (0, 100),
    "patience": (1, 10**9),
    "check_every": (1, 10**9),
}


class FitState(eqx.Module):
    """All that training carries from step to step.

    Training continues bit for bit from a saved and restored state.
    """

    model: ContactDynamics
    optimiser: PyTree
    key: PRNGKeyArray
    step: Int[Array, ""]
    best_model: ContactDynamics
    best_error: Float[Array, ""]
    """m; held-out error of `best_model`, see `rollout_rmse`."""
    checks_without_gain: Int[Array, ""]

    def __repr__(self) -> str:
        return f"FitState(step {self.step}, best_error {self.best_error} m, {self.model!r})"


class TrainingData(eqx.Module):
    """What a training reads. The arrays of `source` and `held_out` are on its devices."""

    config: TrainConfig
    batch: TrajectoryBatch[np.ndarray] | None
    """The trajectories as recorded, on the host, for an objective that takes no steps. Programs
    would be compiled anew for another number of trajectories."""
    source: WindowSource
    held_out: HeldOutWindows
    distractors: int
    """Resting bodies that are added to every window."""
    reports_touch: bool
    """Whether recorded contacts are of bodies that touch; else of bodies that hold each other."""
    split: BatchSplit


@dataclass(frozen=True)
class Objective:
    """What training minimises of a model: all that the loop in `fit` knows of it.

    A model with an objective of its own names it by an attribute ``objective``.
    """

    stepwise = True
    """Whether it is minimised along gradients, in which a network may die; else at once."""
    near_pairs = True
    """Whether edges may be restricted to lists of near pairs."""
    rolls_out = True
    """Whether the errors of rollouts are a term."""
    least_burn = burn = 0
    """Least and most steps before a held-out window, whose motion tells the belief in its first
    state."""
    compared_from = -math.inf
    """Share of the steps after which held-out errors count. The first check after it replaces the
    best model in any case."""

    def optimiser(self, config: TrainConfig) -> optax.GradientTransformation:
        """Of the dynamics, or of the whole model."""
        return optimiser_of(config, bounded_distance(in_lengths=False))

    def optimiser_state(self, model: ContactDynamics, config: TrainConfig) -> PyTree:
        """The state of all optimisers before the first step."""
        return self.optimiser(config).init(eqx.filter(model, eqx.is_inexact_array))

    def advance(
        self, state: FitState, data: TrainingData, count: int, neighbor_list: EdgeList | None
    ) -> tuple[FitState, dict[str, Array]]:
        """The state after ``count`` steps, and the terms of the loss by name, means over them.

        Where there is a ``neighbor_list``, it restricts the edges.
        """
        raise NotImplementedError

    def checked(self, held_out: Dataset, steps: int, devices: int) -> Dataset:
        """The held-out trajectories used in checks, fewer where all would take too long; ``steps``
        is the longest."""
        return held_out

    @eqx.filter_jit
    def first_beliefs(
        self, model: ContactDynamics, held_out: HeldOutWindows, devices: int
    ) -> tuple[ContactBelief, TrajectoryBatch[Array]]:
        """The beliefs in the first states of held-out windows; and the windows, with what the
        motion before them tells of their bodies."""
        windows = held_out.windows
        first = windows.position[:, 0], windows.velocity[:, 0], windows.nodes
        edges = edge_count(model.neighbor_list, windows.position.shape[-2])
        return chunked_vmap(model.initial_belief, *first, edges=edges), windows


def optimiser_of(
    config: TrainConfig, *further: optax.GradientTransformation, steps: int | None = None
) -> optax.GradientTransformation:
    """Adam with a rate that rises and then falls along a cosine, by default over all steps, and
    ``further`` changes of its updates."""
    steps = config.steps if steps is None else steps
    rate = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=min(100, steps),
        decay_steps=max(steps, min(100, steps) + 1),
        end_value=0.01 * config.learning_rate,
    )
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate), *further)


def bounded_distance(in_lengths: bool) -> optax.GradientTransformation:
    """Updates that leave a model's learned contact distance at least a tenth of its first guess.

    A negative one would turn the sign of the contact prior. A bound and not a softplus, because
    model files hold the distance itself. With ``in_lengths`` its updates are in units of its first
    guess, not of metres: only impacts tell the distance; beyond the way of a step from the true one
    it has no gradient, and a few updates of millimetres led there, to stay.
    """

    def bounded(updates: ContactDynamics, model: ContactDynamics) -> ContactDynamics:
        features: Any = model.features
        if not getattr(features, "learned", False):
            return updates
        distance, update = (each.features.contact_distance for each in (model, updates))
        update = features.length * update if in_lengths else update
        least = _SHORTEST * features.length
        update = jnp.where(distance + update < least, least - distance, update)
        return eqx.tree_at(lambda each: each.features.contact_distance, updates, update)

    return optax.stateless(bounded)


def descend(
    slope: Callable[[PyTree, PRNGKeyArray], tuple[PyTree, PyTree]],
    optimiser: optax.GradientTransformation,
    params: PyTree,
    optimiser_state: optax.OptState,
    keys: PRNGKeyArray,
) -> tuple[PyTree, optax.OptState, PyTree]:
    """The parameters and the optimiser's state after a step with each of the keys, in one scan.

    ``slope`` returns the gradient, and what is to be known of the step, of which the means over all
    steps are returned.
    """

    def step(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, PyTree]:
        params, state = carry
        gradient, terms = slope(params, key)
        updates, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), terms

    (params, optimiser_state), terms = jax.lax.scan(step, (params, optimiser_state), keys)
    return params, optimiser_state, jax.tree.map(jnp.mean, terms)
