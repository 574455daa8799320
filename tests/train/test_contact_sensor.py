"""Recorded contacts: reports of random sensors, and the errors of the one that recorded them."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import CONFIG, first_state, split, window_of

from contactgraph.data import Dataset, InvalidInputError, Nodes, TrajectoryBatch, strip_contacts
from contactgraph.inference.contact_belief import nothing_active
from contactgraph.model import (
    HOLD,
    TOUCH,
    ContactSensor,
    ModelConfig,
    ours,
)
from contactgraph.train import check_contacts, fit
from contactgraph.train import filter_loss as reports_module
from contactgraph.train.filter_loss import denial_score, filter_loss, random_reports
from contactgraph.train.identification import likeliest_sensor
from contactgraph.train.motion_evidence import motion_evidence

STILL, NOTHING = jnp.zeros(2), nothing_active((TOUCH, HOLD))

MODEL = ours(ModelConfig(2, 2, 0.05, width=8), key=jax.random.key(0))
KEY = jax.random.key(1)
USED = jnp.ones((4, 40), bool)


def labels(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Contacts that last for some ten steps."""
    changes = np.random.default_rng(seed).random(shape) < 0.1
    return (np.cumsum(changes, axis=1) % 2).astype(np.float32)


def test_reports_without_errors_are_the_contacts_late_by_up_to_three_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reports_module, "_MOST_WRONG", 0.0)
    contact = labels(0, (4, 41, 3))
    report, found = random_reports(jnp.asarray(contact), KEY, USED.at[:, 30:].set(False))
    report, delays = np.asarray(report), []
    for trajectory in range(4):
        delays.append(int(np.isnan(report[trajectory, :, 0]).argmin()))
        late = max(0, delays[-1])  # step t leads to state t + 1; no state is before the first
        shift = next(d for d in range(4) if np.array_equal(
            report[trajectory, late:30], contact[trajectory, late + 1 - d : 31 - d]
        ))  # fmt: skip
        assert shift <= late + 1
        assert (float(found.miss[trajectory]) > 0.0) == (shift > 0)
    assert np.isnan(report[:, 30:]).all()
    assert len({float(each) for each in found.miss}) > 1, "delays differ"


def test_errors_have_the_rates_that_the_correction_assumes() -> None:
    contact = jnp.asarray(labels(1, (64, 401, 3)))
    report, found = random_reports(contact, KEY, jnp.ones((64, 400), bool))
    synchronous = np.asarray(found.miss) < reports_module._MOST_WRONG / 2
    report, true = np.asarray(report)[synchronous], np.asarray(contact)[synchronous, 1:]
    share = np.mean((report != true) & (true > 0.5) & np.isfinite(report), axis=(1, 2))
    assert 0.0 < share.max() < 0.1


def approach() -> TrajectoryBatch:
    """A body that runs into another at rest."""
    position = jnp.zeros((2, 9, 2, 2)).at[:, :, 1, 0].set(0.12)
    position = position.at[:, :, 0, 0].set(0.01 * jnp.arange(9.0))
    velocity = jnp.zeros_like(position).at[:, :, 0, 0].set(0.2)
    return window_of(position, velocity, jnp.zeros((2, 8, 2)))


def test_contacts_change_beliefs_and_nothing_but_the_inference_learns_from_them() -> None:
    """And only where steps are observed."""
    window, mask = approach(), jnp.ones((2, 8), bool)
    # Fresh rates are zero, and then nothing is remembered.
    bias = 3.0 * jnp.eye(3).reshape(-1)
    model = eqx.tree_at(lambda each: each.inference.rates.layers[-1].bias, MODEL, bias)

    @eqx.filter_jit
    def score(contact: jax.Array, observed: jax.Array):
        judged = motion_evidence(model, window)

        def loss(model):
            return filter_loss(model, window._replace(contact=contact), judged, observed, KEY)

        return eqx.filter_value_and_grad(loss)(model)

    reports = [jnp.full((2, 9, 1), each) for each in (jnp.nan, 0.0, 1.0)]
    assert len({float(score(each, mask)[0]) for each in reports}) == 3
    assert len({float(score(each, ~mask)[0]) for each in reports}) == 1
    _, slope = score(reports[1], mask)
    others = slope.local_dynamics, slope.features
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(others)) == 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def synthetic(sensor: ContactSensor, edge_seed: int = 0) -> dict:
    """Bodies that the prior knows to touch or not, and reports of them by this sensor."""
    contact = labels(edge_seed, (8, 201, 1))
    apart = np.where(contact[..., 0] > 0.5, 0.08, 0.12)  # free, but within the cutoff
    position = np.zeros((8, 201, 2, 2), np.float32)
    position[:, :, 1, 0] = apart
    nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))

    def encode(position: jax.Array):
        return MODEL.encode(position, jnp.zeros_like(position), STILL, nodes, NOTHING)

    graph = eqx.filter_jit(jax.vmap(jax.vmap(encode)))(jnp.asarray(position[:, 1:]))
    rng = np.random.default_rng(1)
    wrong = rng.random(contact.shape) < np.where(contact > 0.5, sensor.miss, sensor.false_alarm)
    read = np.where(wrong, 1.0 - contact, contact).astype(np.float32)
    late = np.pad(read, ((0, 0), (sensor.delay, 0), (0, 0)))[:, : read.shape[1]]
    ratio = jnp.zeros((8, 200, 1, 3, 3))
    real = jnp.ones((8, 200), bool)
    return {"graph": graph, "log_ratio": ratio, "contact": jnp.asarray(late), "real": real}


def test_rates_and_delay_are_recovered() -> None:
    for true in (ContactSensor(0.08, 0.03, True, 2), ContactSensor(0.02, 0.1)):
        found = likeliest_sensor(MODEL, **synthetic(true))
        assert (found.delay, found.reports_touch) == (true.delay, True)
        assert found.false_alarm == pytest.approx(true.false_alarm, abs=0.02)
        assert found.miss == pytest.approx(true.miss, abs=0.02)


def test_contacts_are_read_only_where_asked_for(recorded: Path) -> None:
    parts = split(recorded)
    bare = tuple(Dataset(strip_contacts(each).trajectories, each.metadata) for each in parts)
    config = dataclasses.replace(CONFIG, use_contacts=True)
    for given, expected in ((bare, "have no contact field"), (parts, "must be a filter")):
        state = first_state()
        if given is bare:
            state = dataclasses.replace(state, model=MODEL)
        with pytest.raises(InvalidInputError, match=expected):
            fit(state, *given, config)
    check_contacts(MODEL, parts[0], "")


@jax.jit
def denied(distance: jax.Array, speed: jax.Array, rate: jax.Array) -> jax.Array:
    """The denial score of two bodies at this distance that approach each other, or not."""
    bias = rate * jnp.eye(3).reshape(-1)
    model = eqx.tree_at(lambda each: each.inference.rates.layers[-1].bias, MODEL, bias)
    position = jnp.zeros((1, 5, 2, 2)).at[..., 1, 0].set(distance)
    velocity = jnp.zeros_like(position).at[..., 0, 0].set(speed)
    nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))

    def encode(position: jax.Array, velocity: jax.Array):
        return model.encode(position, velocity, STILL, nodes, NOTHING)

    graph = jax.vmap(jax.vmap(encode))(position, velocity)
    return denial_score(model, graph, KEY)


def test_what_a_sensor_denies_about_bodies_that_touch_at_rest_is_to_last() -> None:
    touch = float(MODEL.features.contact_distance)
    forgets, keeps = denied(touch, 0.0, 0.0), denied(touch, 0.0, 14.0)
    assert forgets == pytest.approx(-np.log(1.0 - 0.94), rel=0.1)
    assert keeps < 0.05
    assert denied(1.5 * touch, 0.0, 0.0) < 0.05, "no contact is expected there"
    assert denied(1.2 * touch, 2.0, 0.0) < 1e-3, "an impact may make a contact"
