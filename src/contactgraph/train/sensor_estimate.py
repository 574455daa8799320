"""Errors of the sensor that recorded a dataset's contacts, estimated by a trained filter."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.data.dataset import Dataset, with_edge_labels
from contactgraph.data.trajectory_batch import pad_trajectories
from contactgraph.inference.contact_belief import (
    ContactBelief,
    ContactSensor,
    correct,
    posterior_by_motion,
)
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.filter import on_device
from contactgraph.train.batch import Window
from contactgraph.train.filter_loss import check_contacts, encoded_steps, predict_and_score
from contactgraph.train.judged_steps import judge_steps, with_window_masses

_LATEST = 3
"""Longest delay considered, steps."""
_LEAST, _MOST = 1e-5, 0.5
"""Bounds of an estimated rate: an exact sensor, and one that says nothing."""
_ITERATIONS, _SETTLED = 30, 1e-3
"""Most steps of expectation maximisation, and the relative change below which it ends."""
_BATCH = 8
"""Trajectories in a compiled call."""


class ReportedSteps(eqx.Module):
    """The encoded steps of some trajectories, and what their motion says."""

    graph: EncodedGraph
    ratio: Float[Array, "B T E K K"]
    contact: Float[Array, "B T+1 E"]
    real: Bool[Array, "B T"]


def estimate_sensor(model: ContactDynamics, dataset: Dataset) -> ContactSensor:
    """The sensor that most probably recorded the contacts of a dataset, by a trained filter.

    Expectation maximisation for every delay up to 3 steps, and for a sensor that reports touch or
    only holding where the model tells them apart: the rates are the expected shares of wrong
    reports under the beliefs that motion and the sensor itself have corrected. The likeliest of
    all is returned. Contacts are `with_edge_labels`. Raises `InvalidInputError` where a trajectory
    has none, or the model is no filter.
    """
    check_contacts(model, dataset, "a sensor cannot be estimated")
    return likeliest_sensor(model, list(_encoded(model, with_edge_labels(dataset))))


def likeliest_sensor(model: ContactDynamics, parts: list[ReportedSteps]) -> ContactSensor:
    """`estimate_sensor` from encoded steps."""
    touches = any(each.unilateral for each in model.inference.edge_types)
    kinds = (True, False) if touches else (True,)
    found = [
        _settled(model, parts, ContactSensor(0.05, 0.05, touch, delay))
        for touch in kinds
        for delay in range(_LATEST + 1)
    ]
    return max(found, key=lambda one: one[1])[0]


def _encoded(model: ContactDynamics, dataset: Dataset) -> Iterator[ReportedSteps]:
    batch = pad_trajectories(dataset, turn_length=model.features.turn_length)
    contact = batch.contact
    assert contact is not None

    @eqx.filter_jit
    def judged(model: ContactDynamics, windows: Window) -> tuple[EncodedGraph, Array]:
        judged = judge_steps(model, windows)
        windows = with_window_masses(windows, judged.masses)
        return encoded_steps(model, windows, judged), judged.log_ratio

    for begin in range(0, len(dataset), _BATCH):
        index = np.minimum(np.arange(begin, begin + _BATCH), len(dataset) - 1)
        real = batch.step_mask[index] & (np.arange(begin, begin + _BATCH) == index)[:, None]
        taken = on_device(batch.at(index), np.dtype(np.float32))
        windows = Window(taken.position, taken.velocity, taken.control, taken.nodes)
        graph, ratio = judged(model, windows)
        reports = jnp.asarray(contact[index], jnp.float32)
        yield ReportedSteps(graph, ratio, reports, jnp.asarray(real))


def _settled(
    model: ContactDynamics, parts: list[ReportedSteps], sensor: ContactSensor
) -> tuple[ContactSensor, float]:
    """The sensor with the rates at which the iteration settles, and its log-likelihood."""
    rates, likelihood = np.asarray((sensor.false_alarm, sensor.miss)), -np.inf
    for _ in range(_ITERATIONS):
        before, delay = rates, jnp.asarray(sensor.delay)
        found = [
            _expected(model, part, jnp.asarray(rates), delay, sensor.reports_touch)
            for part in parts
        ]
        wrong, total = np.sum([np.asarray(counts) for counts, _ in found], axis=0)
        likelihood = float(sum(each for _, each in found))
        rates = np.clip(wrong / np.maximum(total, 1e-9), _LEAST, _MOST)
        if np.all(np.abs(rates - before) <= _SETTLED * before):
            break
    false_alarm, miss = map(float, rates)
    return dataclasses.replace(sensor, false_alarm=false_alarm, miss=miss), likelihood


@eqx.filter_jit
def _expected(
    model: ContactDynamics,
    steps: ReportedSteps,
    rates: Float[Array, " 2"],
    delay: Int[Array, ""],
    reports_touch: bool,
) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
    """Expected wrong reports, and all, without contact and with it; the log-likelihood of all.

    Steps whose report some other delay would leave out count for none, so that all are compared on
    the same ones.
    """
    assumed = ContactSensor(rates[0], rates[1], reports_touch)
    length = steps.real.shape[1]
    padded = jnp.pad(
        steps.contact, ((0, 0), (0, _LATEST), (0, 0)), constant_values=jnp.nan
    )  # state t + 1 + delay reports about step t
    report = jax.lax.dynamic_slice_in_dim(padded, 1 + delay, length, axis=1)
    compared = jnp.pad(steps.real, ((0, 0), (0, _LATEST)))[:, _LATEST:]

    def along(
        graph: EncodedGraph, ratio: Array, report: Array, compared: Array
    ) -> tuple[Array, Array]:
        def step(belief: ContactBelief, inputs: tuple) -> tuple[ContactBelief, tuple[Array, Array]]:
            graph, ratio, report, compared = inputs
            predicted, joint, score = predict_and_score(model, belief, graph, ratio)
            by_motion = posterior_by_motion(predicted, joint, ratio)
            after = correct(by_motion, report, assumed)
            counted = compared & (graph.weight > 0) & jnp.isfinite(report)
            said = jnp.where(counted, report, 0.0)
            expected = jnp.where(counted, assumed.contact_probability(after), 0.0)
            without = jnp.where(counted, 1.0 - assumed.contact_probability(after), 0.0)
            wrong = jnp.stack([jnp.sum(without * said), jnp.sum(expected * (1.0 - said))])
            total = jnp.stack([jnp.sum(without), jnp.sum(expected)])
            p = assumed.contact_probability(by_motion)
            if_contact = jnp.where(said > 0.5, 1.0 - assumed.miss, assumed.miss)
            if_none = jnp.where(said > 0.5, assumed.false_alarm, 1.0 - assumed.false_alarm)
            likelihood = jnp.log(p * if_contact + (1.0 - p) * if_none) - score
            return after, (
                jnp.stack([wrong, total]),
                jnp.sum(jnp.where(counted, likelihood, 0.0)),
            )

        first = model.prior_belief(jax.tree.map(lambda leaf: leaf[0], graph))
        counts, likelihood = jax.lax.scan(step, first, (graph, ratio, report, compared))[1]
        return jnp.sum(counts, axis=0), jnp.sum(likelihood)

    counts, likelihood = jax.vmap(along)(steps.graph, steps.ratio, report, compared)
    return jnp.sum(counts, axis=0), jnp.sum(likelihood)
