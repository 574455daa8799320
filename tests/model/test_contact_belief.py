"""Bayes' rule on an edge: by hand, under contradiction, as an algebra; sensors with a delay."""

import dataclasses
from pathlib import Path

import equinox as eqx
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from jax.test_util import check_grads
from model_scenes import nodes_of

from contactgraph.data import InvalidInputError, TrajectoryBatch
from contactgraph.inference.contact_belief import late_rate
from contactgraph.model import (
    HOLD,
    TOUCH,
    ContactBelief,
    ContactSensor,
    EdgeType,
    ModelConfig,
    correct,
    default_sensor,
    load_model,
    ours,
    save_model,
    two_type_belief,
)
from contactgraph.model.filter import filter_trajectory

SENSOR = ContactSensor(false_alarm=0.02, miss=0.1)
jitted_correct = jax.jit(correct)


@jax.jit
def posterior_probability(probability, measurement, sensor) -> jax.Array:
    return correct(two_type_belief(probability), measurement, sensor).probability


def corrected(probability, measurement, sensor=SENSOR) -> np.ndarray:
    given = (np.atleast_1d(np.asarray(value, np.float32)) for value in (probability, measurement))
    return np.asarray(posterior_probability(*given, sensor))


def test_bayes_by_hand() -> None:
    # Paper, eq. (4): 0.9 active and "no contact" must be believed; the authors' code says 0.5.
    np.testing.assert_allclose(
        corrected(0.9, 0.0, ContactSensor(0.01, 0.01)), 0.009 / 0.108, rtol=1e-5
    )
    np.testing.assert_allclose(corrected(0.3, 1.0), 0.3 * 0.9 / (0.3 * 0.9 + 0.7 * 0.02), rtol=1e-5)
    np.testing.assert_allclose(corrected(0.3, 0.0), 0.3 * 0.1 / (0.3 * 0.1 + 0.7 * 0.98), rtol=1e-5)
    # Half sure of contact: each likelihood is the mean of the two.
    np.testing.assert_allclose(corrected(0.3, 0.5), 0.3 * 0.5 / (0.3 * 0.5 + 0.7 * 0.5), rtol=1e-5)


def test_what_a_sensor_reports_follows_from_the_types_in_any_order() -> None:
    types = (HOLD, EdgeType("magnet"), TOUCH)
    prior = np.array([[0.1, 0.2, 0.3, 0.4]])
    belief = ContactBelief(jnp.array(prior), edge_types=types)
    np.testing.assert_allclose(belief.holding, 0.2, rtol=1e-6)
    np.testing.assert_allclose(belief.contact, 0.6, rtol=1e-6)
    np.testing.assert_allclose(belief.probability, 0.9, rtol=1e-6)
    for touch, reported in ((True, [0, 1, 0, 1]), (False, [0, 1, 0, 0])):
        sensor = dataclasses.replace(SENSOR, reports_touch=touch)
        found = correct(belief, jnp.ones(1), sensor)
        expected = prior * np.where(reported, 0.9, 0.02)
        np.testing.assert_allclose(found.type_probability, expected / expected.sum(), rtol=1e-5)
        assert found.edge_types == types


@pytest.mark.parametrize("measurement", [0.0, 1.0, 0.5])
@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_a_sure_belief_survives_contradiction_and_stays_open(probability, measurement) -> None:
    for sensor in (SENSOR, ContactSensor(0.0, 0.0), ContactSensor(1.0, 1.0)):
        once = corrected(probability, measurement, sensor)
        assert np.all((once >= 0) & (once <= 1))
    # A sensor that is never wrong is believed, but no wrong certainty is for ever.
    belief = two_type_belief(jnp.array([probability]))
    for _ in range(14):
        belief = jitted_correct(belief, np.array([1.0 - probability]), SENSOR)
    np.testing.assert_allclose(belief.probability, [1.0 - probability], atol=1e-2)


def test_unmeasured_edges_keep_their_belief_exactly() -> None:
    probability = np.linspace(0, 1, 11, dtype=np.float32)
    for nothing in (np.nan, np.inf, -np.inf):
        found = corrected(probability, np.full(11, nothing))
        np.testing.assert_array_equal(found, two_type_belief(jnp.asarray(probability)).probability)


def test_measurements_out_of_range_count_as_the_nearest_possible() -> None:
    np.testing.assert_array_equal(corrected(0.3, 7.0), corrected(0.3, 1.0))
    np.testing.assert_array_equal(corrected(0.3, -1.0), corrected(0.3, 0.0))


def test_every_edge_may_have_a_sensor_of_its_own() -> None:
    sensor = ContactSensor(jnp.array([0.01, 0.2]), jnp.array([0.3, 0.1]))
    for edge, one in enumerate((ContactSensor(0.01, 0.3), ContactSensor(0.2, 0.1))):
        for said in (0.0, 1.0):
            together = corrected([0.4, 0.4], jnp.full(2, said), sensor)
            assert together[edge] == corrected(0.4, said, one)


EDGES = 8
probabilities = hnp.arrays(np.float32, (EDGES, 3), elements=st.floats(0, 1, width=32))
measurements = hnp.arrays(
    np.float32,
    EDGES,
    elements=st.one_of(st.sampled_from([0.0, 1.0, np.nan]), st.floats(0, 1, width=32)),
)
rates = st.floats(0, 1)


@settings(max_examples=200, deadline=None)
@given(raw=probabilities, measurement=measurements, false_alarm=rates, miss=rates)
def test_a_corrected_belief_is_a_belief(raw, measurement, false_alarm, miss) -> None:
    raw = (raw + 1e-3) / (raw + 1e-3).sum(axis=-1, keepdims=True)
    sensor = ContactSensor(false_alarm, miss)
    found = np.asarray(jitted_correct(ContactBelief(raw), measurement, sensor).type_probability)
    assert np.all((found >= 0) & (found <= 1))
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-5)
    # The sensor tells active from inactive, not the active types from each other.
    np.testing.assert_allclose(found[:, 1] * raw[:, 2], found[:, 2] * raw[:, 1], atol=1e-5)


@settings(max_examples=100, deadline=None)
@given(
    probability=st.floats(0.01, 0.99), false_alarm=st.floats(0.01, 0.4), miss=st.floats(0.01, 0.4)
)
def test_contact_raises_and_none_lowers_and_order_does_not_matter(
    probability, false_alarm, miss
) -> None:
    sensor = ContactSensor(false_alarm, miss)
    up, down = (corrected(probability, value, sensor) for value in (1.0, 0.0))
    assert down <= probability + 1e-6 and up >= probability - 1e-6
    np.testing.assert_allclose(corrected(up, 0.0, sensor), corrected(down, 1.0, sensor), atol=1e-4)


@pytest.mark.usefixtures("double_precision")
def test_derivatives_against_finite_differences() -> None:
    def posterior(probability, measurement):
        belief = ContactBelief(probability)
        return correct(belief, measurement, SENSOR).type_probability

    probability = jnp.array([[0.5, 0.3, 0.2], [0.05, 0.9, 0.05], [0.98, 0.01, 0.01]])
    check_grads(jax.jit(posterior), (probability, jnp.array([0.8, 0.1, 0.4])), order=1, eps=1e-6)


@pytest.mark.usefixtures("double_precision")
def test_an_edge_that_was_not_measured_has_a_finite_gradient() -> None:
    def total(probability):
        found = correct(two_type_belief(probability), jnp.array([jnp.nan, 1.0]), SENSOR)
        return jnp.sum(found.probability)

    slope = jax.jit(jax.grad(total))(jnp.array([0.3, 1.0]))
    assert slope[0] == 1 and np.all(np.isfinite(slope))


CONFIG = ModelConfig(2, 2, 0.05, width=8)
MODEL = FRESH = ours(CONFIG, key=jax.random.key(0))
STATES = 8


def trajectory(report: np.ndarray) -> TrajectoryBatch:
    """Two bodies that part slowly, of which a sensor reports this."""
    position = jnp.zeros((STATES, 2, 2)).at[:, 1, 0].set(0.08 + 0.004 * jnp.arange(STATES))
    still = jnp.zeros_like(position)
    control = jnp.zeros((STATES - 1, 2))
    contact = jnp.asarray(report, jnp.float32)[:, None]
    return TrajectoryBatch(position, still, control, contact, nodes_of(2), jnp.asarray(STATES - 1))


def posterior(report: np.ndarray, sensor: ContactSensor) -> np.ndarray:
    found = eqx.filter_jit(filter_trajectory)(MODEL, trajectory(report), sensor)
    return np.asarray(found.posterior.type_probability[:, 0])


def test_a_late_report_counts_as_a_current_one_of_less_weight() -> None:
    report = np.array([1.0, 1.0, 0.0, np.nan, 1.0, 0.0, 0.0, 1.0])
    late = ContactSensor(0.05, 0.1, True, delay=2)
    found = posterior(report, late)
    np.testing.assert_array_equal(found, posterior(report, late.as_current))
    assert np.abs(found - posterior(report, ContactSensor(0.05, 0.1))).max() > 0.01


def test_the_errors_of_late_reports_that_count_as_current() -> None:
    late = ContactSensor(0.1, 0.0, False, 2)
    changed = 2 * 0.02 * 0.98  # once in two steps
    expected = 0.1 * (1 - changed) + 0.9 * changed, changed
    found = late.as_current
    assert (found.false_alarm, found.miss) == pytest.approx(expected)
    assert (found.delay, found.reports_touch) == (0, False)
    assert late_rate(0.3, 0) == 0.3


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"miss": 1.1}, "miss must be 0 to 1, found 1.1"),
        ({"false_alarm": float("nan")}, "false_alarm must be"),
        ({"delay": -1}, "delay must be at least 0 steps, found -1"),
    ],
)
def test_impossible_sensors(wrong: dict, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        ContactSensor(**wrong)


def test_a_model_file_keeps_the_sensor(tmp_path: Path) -> None:
    sensor = ContactSensor(0.03, 0.07, False, 2)
    path = tmp_path / "model.safetensors"
    save_model(path, dataclasses.replace(FRESH, sensor=sensor), "ours", CONFIG)
    assert default_sensor(load_model(path).model) == sensor
    save_model(path, FRESH, "ours", CONFIG)
    stored = load_model(path).model
    assert stored.sensor is None
    assert default_sensor(stored) == ContactSensor() == default_sensor(object())
