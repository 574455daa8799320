"""What is believed about each edge, and how a measured contact corrects it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.model.collision import Geometry

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
    edge_id: Int[Array, "*T E"] | None = None
    """Which pair each edge is where only some are listed: `Edges.edge_id`. All others are inactive
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
            if self.edge_id is None:
                return self
            everywhere = jnp.repeat(inactive, count, axis=0)
            return ContactBelief(everywhere.at[self.edge_id].set(types, mode="drop"))
        if self.edge_id is None:
            listed = types.at[edge].get(mode="clip")
            return ContactBelief(jnp.where((edge < count)[:, None], listed, inactive), edge)
        # Both ascend.
        place = jnp.minimum(jnp.searchsorted(self.edge_id, edge), self.edge_id.shape[0] - 1)
        known = self.edge_id[place] == edge
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
    if belief.edge_id is not None:
        edge = belief.edge_id
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
        jnp.where(measured[..., None], posterior, belief.type_probability), belief.edge_id
    )


def _listed(rate: float | Array, edge: Int[Array, " E"]) -> float | Array:
    return rate if jnp.ndim(rate) == 0 else jnp.asarray(rate).at[edge].get(mode="clip")


class DistancePrior(eqx.Module):
    r"""The paper's prior: probability of contact from the distance $d$ of two nodes, as it is now.

    $$ q = \sigma\big( 2 (d_{th} - d) / s \big), \qquad
       s = s_\text{inside}\ (d < d_{th}),\ s_\text{outside}\ (d \ge d_{th}) $$

    With both scales 1 m it is the paper's text; its authors' prior is ten times as sharp inside.
    """

    threshold: float = eqx.field(static=True, default=0.1)
    """d_th, m."""
    inside: float = eqx.field(static=True, default=0.1)
    """Scale below the threshold, m."""
    outside: float = eqx.field(static=True, default=1.0)
    """Scale above the threshold, m."""

    def __call__(
        self, geometry: Geometry, contact_distance: Float[Array, ""] | float
    ) -> Float[Array, " E"]:
        """Prior probability that each edge is active; `contact_distance` has no say."""
        margin = self.threshold - geometry.distance
        scale = jnp.where(margin > 0, self.inside, self.outside)
        return jax.nn.sigmoid(2.0 * margin / scale)


class ClosestApproachPrior(eqx.Module):
    r"""Contact is where two nodes are, or come within the step, as near as bodies touch.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the distance of touch, which the model learns from impacts, and $d$ the distance of
    closest approach in the coming step: the edge of a step must already be active when bodies
    touch *within* it. No gradient goes to $\rho$. Never surer than $\epsilon$, because a force of
    which nothing is known yet may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.03)
    """m; how much farther than the distance of touch counts as touching."""
    sharpness: float = eqx.field(static=True, default=0.02)
    """s."""
    min_probability: float = eqx.field(static=True, default=0.01)
    """epsilon."""

    def __call__(
        self, geometry: Geometry, contact_distance: Float[Array, ""] | float
    ) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(jnp.asarray(contact_distance))
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        return self.min_probability + (1.0 - 2.0 * self.min_probability) * jax.nn.sigmoid(
            2.0 * margin
        )


class ArgmaxSample(eqx.Module):
    """The most probable type; the gradient passes straight through to the probability."""

    def __call__(
        self, type_probability: Float[Array, "*T E K"], key: PRNGKeyArray | None
    ) -> Float[Array, "*T E K"]:
        """One-hot edge types. No key is needed."""
        return _straight_through(type_probability, type_probability)


class GumbelSample(eqx.Module):
    """A draw from the probability (Gumbel-max), straight through to a softened draw.

    Without a key it is the most probable type: plans are made without chance.
    """

    temperature: float = eqx.field(static=True, default=1.0)

    def __call__(
        self, type_probability: Float[Array, "*T E K"], key: PRNGKeyArray | None
    ) -> Float[Array, "*T E K"]:
        """One-hot edge types."""
        if key is None:
            return _straight_through(type_probability, type_probability)
        logits = jnp.log(jnp.clip(type_probability, 1e-6, 1.0))
        noisy = logits + jax.random.gumbel(key, logits.shape, logits.dtype)
        # Where the soft draw is used the probability itself must not gain mass at exactly 0.
        noisy = jnp.where(type_probability > 0, noisy, -jnp.inf)
        return _straight_through(jax.nn.softmax(noisy / self.temperature, axis=-1), noisy)


def _straight_through(soft: Array, scores: Array) -> Array:
    hard = jax.nn.one_hot(jnp.argmax(scores, axis=-1), scores.shape[-1], dtype=soft.dtype)
    return hard + soft - jax.lax.stop_gradient(soft)


class SmoothCutoff(eqx.Module):
    """How far an edge can be active: weight 1 below `inner` [m], exactly 0 from `outer` [m] on.

    What is out of reach of everything changes nobody's prediction, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1]."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """No limit to an edge's reach: the paper's all-pairs inference."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)
