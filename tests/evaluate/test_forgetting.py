"""Beliefs about touching bodies that a sensor reports as free."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.evaluate import forgetting
from contactgraph.model import ContactSensor, ModelConfig, hidden_markov_filter

FRESH = hidden_markov_filter(ModelConfig(2, 2, 0.05, width=8), key=jax.random.key(0))
SENSOR = ContactSensor()


def with_rates(rate: float):
    """A filter whose types last the longer, the larger the rate."""
    bias = rate * jnp.eye(3).reshape(-1)
    return eqx.tree_at(lambda each: each.inference.rates.layers[-1].bias, FRESH, bias)


def test_geometry_is_believed_at_once_by_a_filter_without_memory() -> None:
    found = forgetting(FRESH, SENSOR)
    # The prior at the contact distance, sigmoid(3), within the least transitions.
    prior = 0.01 + 0.98 * float(jax.nn.sigmoid(3.0))
    assert found.coming == pytest.approx(prior, abs=5e-3)
    assert found.later == pytest.approx(found.coming, abs=1e-5)


def test_what_was_measured_lasts_with_the_types() -> None:
    found = forgetting(with_rates(14.0), SENSOR)
    assert found.coming < 0.01  # two active types, each at least 0.002
    assert found.coming < found.later < 0.1
    chain = forgetting(with_rates(14.0), SENSOR, bodies=3)
    assert chain.coming == pytest.approx(found.coming, abs=1e-4)
    assert forgetting(with_rates(14.0), SENSOR, later_s=0.0).later == found.coming


def test_impossible_scenes() -> None:
    for wrong in ({"bodies": 1}, {"measurements": 0}, {"later_s": -1.0}):
        with pytest.raises(InvalidInputError, match="at least 2 bodies, 1 measurement"):
            forgetting(FRESH, SENSOR, **wrong)
