"""Sensors with a delay, and the sensor that a model file holds."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data import InvalidInputError, Nodes, TrajectoryBatch
from contactgraph.model import (
    ContactSensor,
    ModelConfig,
    default_sensor,
    hidden_markov_filter,
    load_model,
    save_model,
)
from contactgraph.model.contact_belief import late_rate
from contactgraph.model.filter import filter_trajectory

FRESH = hidden_markov_filter(ModelConfig(2, 2, 0.05, width=8), key=jax.random.key(0))
# Fresh rates are zero, and then nothing is remembered.
MODEL = eqx.tree_at(
    lambda each: each.inference.rates.layers[-1].bias, FRESH, 6.0 * jnp.eye(3).reshape(-1)
)
STATES = 8


def trajectory(report: np.ndarray) -> TrajectoryBatch:
    """Two bodies that part slowly, of which a sensor reports this."""
    position = jnp.zeros((STATES, 2, 2)).at[:, 1, 0].set(0.08 + 0.004 * jnp.arange(STATES))
    nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))
    still = jnp.zeros_like(position)
    control = jnp.zeros((STATES - 1, 2))
    contact = jnp.asarray(report, jnp.float32)[:, None]
    return TrajectoryBatch(position, still, control, contact, nodes, jnp.asarray(STATES - 1))


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
    save_model(path, dataclasses.replace(FRESH, sensor=sensor))
    assert default_sensor(load_model(path).model) == sensor
    save_model(path, FRESH)
    stored = load_model(path).model
    assert stored.sensor is None
    assert default_sensor(stored) == ContactSensor() == default_sensor(object())
