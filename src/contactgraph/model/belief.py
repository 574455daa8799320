"""What is believed about each edge, and how a measured contact corrects it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALLEST = 1e-6


class ContactSensor(eqx.Module):
    """How often a contact sensor lies: on every edge alike, or each edge's own rates."""

    false_alarm: float | Float[Array, " E"] = 0.01
    """Probability that it reports contact where there is none."""
    miss: float | Float[Array, " E"] = 0.01
    """Probability that it reports none where there is contact."""


class ContactBelief(eqx.Module):
    """Probability of each edge type; type 0 is *inactive*."""

    type_probability: Float[Array, "*T E K"]

    @property
    def probability(self) -> Float[Array, "*T E"]:
        """Probability that the edge is active, of whatever type."""
        return 1.0 - self.type_probability[..., 0]


def two_type_belief(probability: Float[Array, "*T E"]) -> ContactBelief:
    """A belief over {inactive, active} from the probability of *active*."""
    return ContactBelief(jnp.stack([1.0 - probability, probability], axis=-1))


def correct(
    belief: ContactBelief,
    contact_measurement: Float[Array, " E"],
    sensor: ContactSensor,
) -> ContactBelief:
    """Bayes' rule: the belief after a contact sensor has spoken.

    ``contact_measurement`` is 1 (contact), 0 (none), or in between for an unsure sensor;
    NaN means that the edge was not measured and leaves its belief as it was. The result is
    normalised and finite even when prior and measurement contradict each other. Paper, eq. (4),
    with the sensor's own error rates in place of a raw distribution.
    """
    measured = jnp.isfinite(contact_measurement)
    contact = jnp.clip(jnp.where(measured, contact_measurement, 0.5), 0.0, 1.0)
    likelihood_active = contact * (1.0 - sensor.miss) + (1.0 - contact) * sensor.miss
    likelihood_inactive = contact * sensor.false_alarm + (1.0 - contact) * (
        1.0 - sensor.false_alarm
    )
    prior = jnp.clip(belief.type_probability, _SMALLEST, 1.0)
    inactive = prior[..., :1] * jnp.maximum(likelihood_inactive, _SMALLEST)[..., None]
    active = prior[..., 1:] * jnp.maximum(likelihood_active, _SMALLEST)[..., None]
    posterior = jnp.concatenate([inactive, active], axis=-1)
    posterior = posterior / jnp.sum(posterior, axis=-1, keepdims=True)
    return ContactBelief(jnp.where(measured[..., None], posterior, belief.type_probability))
