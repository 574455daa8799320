"""Recorded contacts that correct a filter in training, as random sensors report them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.model.contact_belief import late_rate
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.edge_inference import TransitionEdges

_MOST_WRONG, _LATEST = 0.1, 3
"""Largest error rates, and longest delay [steps], of the sensors of training."""


def check_contacts(model: ContactDynamics, dataset: Dataset, what: str) -> None:
    """Raises `InvalidInputError` where ``what`` lacks a filter, or any trajectory its contacts."""
    if not isinstance(model.inference, TransitionEdges):
        raise InvalidInputError(
            f"{what}: the model must be a filter (--model filter), found "
            f"{type(model.inference).__name__}"
        )
    lacking = sum(each.contact is None for each in dataset)
    if lacking:
        raise InvalidInputError(
            f"{what}: {lacking} of {len(dataset)} trajectories have no contact field; it must be "
            "in every trajectory"
        )


class SensorReports(eqx.Module):
    """What one sensor a trajectory reports of the state that each step leads to."""

    report: Float[Array, "B T E"]
    """1 contact, 0 none, NaN nothing."""
    false_alarm: Float[Array, " B"]
    """As the correction assumes it: see `ContactSensor`."""
    miss: Float[Array, " B"]


def random_reports(
    contact: Float[Array, "B T+1 E"], key: PRNGKeyArray, used: Bool[Array, "B T"]
) -> SensorReports:
    """Reports of recorded contacts at random error rates and delays, in the steps ``used``."""
    false_key, miss_key, delay_key, error_key = jax.random.split(key, 4)
    count, states, _ = contact.shape
    false_alarm, miss = (
        jax.random.uniform(each, (count,), maxval=_MOST_WRONG) for each in (false_key, miss_key)
    )
    delay = jax.random.randint(delay_key, (count,), 0, _LATEST + 1)
    wrong = jnp.where(contact > 0.5, miss[:, None, None], false_alarm[:, None, None])
    is_wrong = jax.random.uniform(error_key, contact.shape) < wrong
    read = jnp.where(is_wrong, 1.0 - contact, contact)
    about = jnp.arange(1, states) - delay[:, None]
    known = used & (about >= 0)
    report = jnp.take_along_axis(read, jnp.maximum(about, 0)[..., None], axis=1)
    return SensorReports(
        jnp.where(known[..., None], report, jnp.nan),
        jnp.asarray(late_rate(false_alarm, delay)),
        jnp.asarray(late_rate(miss, delay)),
    )
