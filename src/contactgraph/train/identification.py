"""System identification without gradients: laws of touches, and errors of contact sensors.

The motion after an impact depends on its place and moment so steeply that gradients through it are
noise. A dozen numbers need none: Gauss-Newton with differences of simulated steps tells them within
seconds. How often a sensor errs follows by expectation maximisation from a trained filter.
"""

import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import EdgeList, EncodedGraph, edge_count, first_where
from contactgraph.data.dataset import Dataset, with_edge_labels
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.padding import pad_trajectories
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.inference.contact_belief import ContactSensor
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.scene import on_device
from contactgraph.train.batch import chunked_vmap, window_source
from contactgraph.train.expectation_maximisation import steps_of_types
from contactgraph.train.motion_evidence import encode_evidence, filter_steps, motion_evidence
from contactgraph.train.objective import FitState, Objective, TrainingData

_SPREADS = {
    "bounce_raw": 0.3,
    "friction_raw": 0.3,
    "log_inertia": 0.02,
}
"""Standard deviations of the numbers about their starts, in their own units: see `ContactLaw`. What
the data do not tell stays there. Outlines of uniform density tell the inertia within a tenth."""
_WINDOWS, _STEPS = 256, 2
"""Windows of the fit, and their steps: more would diverge from the recording after an impact."""
_ERROR = 0.03
"""Error of a step in units of the typical velocity, from which it counts less."""
_GUESSES, _IMPROVED, _DIFFERENCE, _MOST_EVALUATIONS = 64, 2, 0.1, 12
"""Draws of the prior; the best of them that are improved; step of the differences, in spreads; and
most evaluations of the residuals, without those."""
_LATEST = 3
"""Longest delay considered, steps."""
_LEAST_RATE, _MOST_RATE = 1e-5, 0.5
"""Bounds of an estimated rate: an exact sensor, and one that says nothing."""
_ITERATIONS, _SETTLED = 30, 1e-3
"""Most steps of expectation maximisation, and the relative change below which it ends."""


def identifies_laws(model: ContactDynamics) -> bool:
    """Whether `identify_laws` finds all that this model learns: see `ModelConfig.identified`."""
    return getattr(getattr(model.local_dynamics, "head", None), "identified", False)


class LawIdentification(Objective):
    """One call of `identify_laws` in place of optimiser steps."""

    stepwise = False
    near_pairs = False

    def advance(
        self, state: FitState, data: TrainingData, count: int, neighbor_list: EdgeList | None
    ) -> tuple[FitState, dict[str, Array]]:
        """The state with these laws; there is no loss."""
        assert data.batch is not None
        model = identify_laws(state.model, data.batch)
        return replace(state, model=model, step=state.step + count), {}


def identify_laws(model: ContactDynamics, batch: TrajectoryBatch[np.ndarray]) -> ContactDynamics:
    """The model with bounce, friction and inertia by the data.

    Maximum a posteriori: a normal prior about the model's own numbers, and a pseudo-Huber loss of
    the velocities in windows in which something happens; every near pair touches.
    """
    windows = window_source(batch, _STEPS, 1.0).draw(_WINDOWS, jax.random.key(0))
    numbers, as_leaves = ravel_pytree(_leaves(model))
    start, sizes = np.asarray(numbers, float), [each.size for each in _leaves(model)]
    spread = np.repeat(list(_SPREADS.values()), sizes)
    free = np.asarray(windows.nodes.mobile)[:, None, :, None]
    typical = float(np.sqrt(np.mean(np.square(windows.velocity), where=free)))
    # Of bodies at rest, errors count from those on that a part of their weight would make.
    weight = model.dt * float(np.linalg.norm(np.asarray(windows.nodes.gravity)[0]))
    scale = _ERROR * max(typical, weight) * np.sqrt(_STEPS)

    def with_numbers(shift: np.ndarray) -> ContactDynamics:
        # About 1, because differences are relative.
        numbers = jnp.asarray(start + spread * (shift - 1.0), jnp.float32)
        return eqx.tree_at(_leaves, model, as_leaves(numbers))

    def residuals(shift: np.ndarray) -> np.ndarray:
        each = np.asarray(_velocity_errors(with_numbers(shift), windows), float)
        each = each.reshape(_WINDOWS, -1) / scale
        size = np.maximum(np.linalg.norm(each, axis=1, keepdims=True), np.finfo(float).tiny)
        less = np.sqrt(2.0 * (np.sqrt(1.0 + size**2) - 1.0)) / size
        return np.concatenate([np.nan_to_num(each * less).ravel(), shift - 1.0])

    def improved(shift: np.ndarray) -> scipy.optimize.OptimizeResult:
        return scipy.optimize.least_squares(
            residuals, shift, diff_step=_DIFFERENCE, max_nfev=_MOST_EVALUATIONS
        )

    drawn = np.random.default_rng(0).normal(1.0, 1.0, (_GUESSES, len(start)))
    guesses = sorted([np.ones_like(start), *drawn], key=lambda shift: np.sum(residuals(shift) ** 2))
    found = [improved(each) for each in guesses[:_IMPROVED]]
    return with_numbers(min(found, key=lambda each: each.cost).x)


def _leaves(model: Any) -> list[Array]:
    return [getattr(model.local_dynamics.head, name) for name in _SPREADS]


@eqx.filter_jit
def _velocity_errors(
    model: ContactDynamics, windows: TrajectoryBatch[Array]
) -> Float[Array, "B L N G"]:
    """m/s; of the bodies that move freely."""
    edges = edge_count(None, windows.position.shape[-2])

    def errors(window: TrajectoryBatch[Array]) -> Float[Array, "L N G"]:
        types = model.inference.edge_types
        touch = jax.nn.one_hot(first_where(each.unilateral for each in types), 1 + len(types))
        touching = jnp.broadcast_to(touch, (_STEPS, edges, len(touch)))
        _, velocity, _ = steps_of_types(model, window, touching, touching, jnp.asarray(True))
        return jnp.where(window.nodes.mobile[:, None], velocity - window.velocity[1:], 0.0)

    return chunked_vmap(errors, windows, edges=edges)


def check_contacts(model: ContactDynamics, dataset: Dataset, what: str) -> None:
    """Raises `InvalidInputError` where ``what`` lacks a filter, or any trajectory its contacts."""
    if model.prediction_noise is None:
        raise InvalidInputError(
            f"{what}: the model must be a filter (--model ours), found "
            f"{type(model.inference).__name__}"
        )
    lacking = sum(each.contact is None for each in dataset)
    if lacking:
        raise InvalidInputError(
            f"{what}: {lacking} of {len(dataset)} trajectories have no contact field; it must be "
            "in every trajectory"
        )


def estimate_sensor(model: ContactDynamics, dataset: Dataset) -> ContactSensor:
    """The sensor that most probably recorded the contacts of a dataset, by a trained filter.

    Expectation maximisation for every delay up to 3 steps, and for a sensor that reports touch or
    only holding where the model tells them apart: the rates are the expected shares of wrong
    reports under the beliefs that motion and the sensor itself have corrected. The likeliest of
    all is returned. Contacts are `with_edge_labels`. Raises `InvalidInputError` where a trajectory
    has none, or the model is no filter.
    """
    check_contacts(model, dataset, "a sensor cannot be estimated")
    batch = pad_trajectories(with_edge_labels(dataset), turn_length=model.features.turn_length)
    trajectories = on_device(batch, np.dtype(np.float32))
    graph, ratio = _judged(model, trajectories)
    assert trajectories.contact is not None
    real = jnp.asarray(batch.step_mask)
    return likeliest_sensor(model, graph, ratio, trajectories.contact, real)


@eqx.filter_jit
def _judged(
    model: ContactDynamics, trajectories: TrajectoryBatch[Array]
) -> tuple[EncodedGraph, Float[Array, "B T E K K"]]:
    evidence = motion_evidence(model, trajectories)
    return encode_evidence(model, trajectories, evidence), evidence.log_ratio


def likeliest_sensor(
    model: ContactDynamics,
    graph: EncodedGraph,
    log_ratio: Float[Array, "B T E K K"],
    contact: Float[Array, "B T+1 E"],
    real: Bool[Array, "B T"],
) -> ContactSensor:
    """`estimate_sensor` from the encoded steps of trajectories, and what their motion says."""
    touches = any(each.unilateral for each in model.inference.edge_types)
    kinds = (True, False) if touches else (True,)
    found = []
    for kind, delay in itertools.product(kinds, range(_LATEST + 1)):
        rates, shift = np.array([0.05, 0.05]), jnp.asarray(delay)
        for _ in range(_ITERATIONS):
            sensor = ContactSensor(jnp.asarray(rates[0]), jnp.asarray(rates[1]), kind)
            counts = _expected(model, graph, log_ratio, contact, real, sensor, shift)
            wrong, total, likelihood = (np.asarray(each, float) for each in counts)
            before = rates
            rates = np.clip(wrong / np.maximum(total, 1e-9), _LEAST_RATE, _MOST_RATE)
            if np.all(np.abs(rates - before) <= _SETTLED * before):
                break
        estimate = ContactSensor(float(rates[0]), float(rates[1]), kind, delay)
        found.append((float(likelihood), estimate))
    return max(found, key=lambda each: each[0])[1]


@eqx.filter_jit
def _expected(
    model: ContactDynamics,
    graph: EncodedGraph,
    log_ratio: Float[Array, "B T E K K"],
    contact: Float[Array, "B T+1 E"],
    real: Bool[Array, "B T"],
    sensor: ContactSensor,
    delay: Int[Array, ""],
) -> tuple[Float[Array, " 2"], Float[Array, " 2"], Float[Array, ""]]:
    """Expected wrong reports, and all, without contact and with it; the log-likelihood of all.

    Steps whose report some other delay would leave out count for none, so that all are compared on
    the same ones.
    """
    length = real.shape[1]
    # State t + 1 + delay reports about step t.
    padded = jnp.pad(contact, ((0, 0), (0, _LATEST), (0, 0)), constant_values=jnp.nan)
    report = jax.lax.dynamic_slice_in_dim(padded, 1 + delay, length, axis=1)
    compared = jnp.pad(real, ((0, 0), (0, _LATEST)))[:, _LATEST:]
    along = jax.vmap(partial(filter_steps, model, sensor=sensor))
    filtered = along(graph, log_ratio, report)
    counted = compared[..., None] & (graph.weight > 0) & jnp.isfinite(report)
    said = jnp.where(counted, report, 0.0)
    after = sensor.contact_probability(filtered.after)
    active, inactive = (jnp.where(counted, each, 0.0) for each in (after, 1.0 - after))
    wrong = jnp.stack([jnp.sum(inactive * said), jnp.sum(active * (1.0 - said))])
    p = sensor.contact_probability(filtered.by_motion)
    if_contact = jnp.where(said > 0.5, 1.0 - sensor.miss, sensor.miss)
    if_none = jnp.where(said > 0.5, sensor.false_alarm, 1.0 - sensor.false_alarm)
    likelihood = jnp.log(p * if_contact + (1.0 - p) * if_none) - filtered.score
    total = jnp.stack([jnp.sum(inactive), jnp.sum(active)])
    return wrong, total, jnp.sum(jnp.where(counted, likelihood, 0.0))
