"""Recorded contacts: the errors of the sensor that recorded them, and where they are read."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training import CONFIG, first_state, split

from contactgraph.data import Dataset, InvalidInputError, Nodes, strip_contacts
from contactgraph.inference.contact_belief import nothing_active
from contactgraph.model import (
    HOLD,
    TOUCH,
    ContactSensor,
    ModelConfig,
    ours,
)
from contactgraph.train import check_contacts, fit
from contactgraph.train.identification import likeliest_sensor

STILL, NOTHING = jnp.zeros(2), nothing_active((TOUCH, HOLD))

MODEL = ours(ModelConfig(2, 2, 0.05, width=8), key=jax.random.key(0))
KEY = jax.random.key(1)
USED = jnp.ones((4, 40), bool)


def labels(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Contacts that last for some ten steps."""
    changes = np.random.default_rng(seed).random(shape) < 0.1
    return (np.cumsum(changes, axis=1) % 2).astype(np.float32)


def synthetic(sensor: ContactSensor, edge_seed: int = 0) -> dict:
    """Bodies that the prior knows to touch or not, and reports of them by this sensor."""
    contact = labels(edge_seed, (8, 201, 1))
    apart = np.where(contact[..., 0] > 0.5, 0.08, 0.12)  # free, but within the cutoff
    position = np.zeros((8, 201, 2, 2), np.float32)
    position[:, :, 1, 0] = apart
    nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))

    def encode(position: jax.Array):
        """Bodies that approach each other, as they do where a touch begins."""
        velocity = jnp.zeros_like(position).at[1, 0].set(-0.1)
        return MODEL.encode(position, velocity, STILL, nodes, NOTHING)

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
