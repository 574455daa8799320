"""Errors of the sensor that recorded a dataset's contacts, estimated by a trained filter."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.dataset import Dataset, with_edge_labels
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import TrajectoryBatch, pad_trajectories
from contactgraph.inference.contact_belief import ContactSensor
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.filter import on_device
from contactgraph.train.motion_evidence import encode_evidence, filter_steps, motion_evidence

_LATEST = 3
"""Longest delay considered, steps."""
_LEAST, _MOST = 1e-5, 0.5
"""Bounds of an estimated rate: an exact sensor, and one that says nothing."""
_ITERATIONS, _SETTLED = 30, 1e-3
"""Most steps of expectation maximisation, and the relative change below which it ends."""


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
    kinds = (True, False) if model.inference.edge_types > 2 else (True,)
    found = []
    for kind in kinds:
        for delay in range(_LATEST + 1):
            rates, shift = np.array([0.05, 0.05]), jnp.asarray(delay)
            for _ in range(_ITERATIONS):
                sensor = ContactSensor(jnp.asarray(rates[0]), jnp.asarray(rates[1]), kind)
                wrong, total, likelihood = _expected(
                    model, graph, log_ratio, contact, real, sensor, shift
                )
                before, rates = rates, np.asarray(wrong / jnp.maximum(total, 1e-9), float)
                rates = np.clip(rates, _LEAST, _MOST)
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
    filtered = along(graph, log_ratio, jnp.ones_like(real), report)
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
