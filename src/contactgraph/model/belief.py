"""What is believed about each edge, and how a measured contact corrects it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

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
    edge: Int[Array, "*T E"] | None = None
    """Which pair each edge is where only some are listed: `Edges.number`. All others are inactive
    for sure. None: all pairs, in `pair_indices`' order."""

    @property
    def probability(self) -> Float[Array, "*T E"]:
        """Probability that the edge is active, of whatever type."""
        return 1.0 - self.type_probability[..., 0]

    def over(self, edge: Int[Array, " E"] | None, count: int) -> "ContactBelief":
        """The same, at one step, over other edges; `count` is how many pairs there are."""
        types = self.type_probability
        inactive = jnp.zeros_like(types[:1]).at[:, 0].set(1.0)
        if edge is None:
            if self.edge is None:
                return self
            everywhere = jnp.repeat(inactive, count, axis=0)
            return ContactBelief(everywhere.at[self.edge].set(types, mode="drop"))
        if self.edge is None:
            listed = types.at[edge].get(mode="clip")
            return ContactBelief(jnp.where((edge < count)[:, None], listed, inactive), edge)
        # Both ascend.
        place = jnp.minimum(jnp.searchsorted(self.edge, edge), self.edge.shape[0] - 1)
        known = self.edge[place] == edge
        return ContactBelief(jnp.where(known[:, None], types[place], inactive), edge)


def two_type_belief(probability: Float[Array, "*T E"]) -> ContactBelief:
    """A belief over {inactive, active} from the probability of *active*."""
    return ContactBelief(jnp.stack([1.0 - probability, probability], axis=-1))


def correct(
    belief: ContactBelief,
    contact_measurement: Float[Array, " all"],
    sensor: ContactSensor,
) -> ContactBelief:
    """Bayes' rule: the belief after a contact sensor has spoken.

    ``contact_measurement`` is 1 (contact), 0 (none), or in between for an unsure sensor;
    NaN means that the edge was not measured and leaves its belief as it was. The result is
    normalised and finite even when prior and measurement contradict each other. Paper, eq. (4),
    with the sensor's own error rates in place of a raw distribution. Measurements, and rates that
    are each edge's own, are of all pairs; what is measured of an edge that is not listed is lost.
    """
    if belief.edge is not None:
        edge = belief.edge
        contact_measurement = contact_measurement.at[edge].get(mode="fill", fill_value=jnp.nan)
        sensor = jax.tree.map(lambda rate: _listed(rate, edge), sensor)
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
    return ContactBelief(
        jnp.where(measured[..., None], posterior, belief.type_probability), belief.edge
    )


def _listed(rate: float | Array, edge: Int[Array, " E"]) -> float | Array:
    return rate if jnp.ndim(rate) == 0 else jnp.asarray(rate).at[edge].get(mode="clip")
