"""Beliefs about contact: transitions, corrections by measurements and motion, and sampling."""

import dataclasses
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.bodies.graph import EdgeType, usual_edge_types
from contactgraph.data.errors import InvalidInputError

_MIN_PROBABILITY = 1e-6
_MIN_JOINT = 1e-12
_LEAST_TYPE = 0.01
"""Of a prediction without transitions, where motion contradicts it."""
_CHANGE = 0.02
"""Probability a step that a contact begins or ends, as far as a late report is concerned."""


class EdgeMemory(eqx.Module):
    """State of the inference of every edge besides the types; this one holds nothing.

    An inference that remembers has a class of its own, whose arrays are [*T, E, ...] and are 0
    where an edge is not listed.
    """

    def after_motion(
        self,
        joint: Float[Array, "E K K"],
        posterior: Float[Array, "E K K"],
        evidence: Bool[Array, "E 1"],
    ) -> Self:
        """That after motion has led from ``joint``, the predicted pairs of types, to ``posterior``.

        Motion says nothing about edges without ``evidence``.
        """
        return self

    def after_report(self, before: Float[Array, "*T E K"], after: Float[Array, "*T E K"]) -> Self:
        """That after a sensor's report has changed the probability of the types."""
        return self


class ContactBelief(eqx.Module):
    """Probability of each edge type, of which the first is *inactive*."""

    type_probability: Float[Array, "*T E K"]
    edge_id: Int[Array, "*T E"] | None = None
    """`Edges.edge_id` where only some pairs are listed; all others are inactive with certainty.
    None: all pairs, in `pair_indices`' order."""
    memory: EdgeMemory = EdgeMemory()
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=())
    """The active types, by default the `usual_edge_types`."""

    def __post_init__(self) -> None:
        self.edge_types = self.edge_types or usual_edge_types(self.type_probability.shape[-1])

    @property
    def probability(self) -> Float[Array, "*T E"]:
        """Probability that the edge is active, of any active type."""
        return 1.0 - self.type_probability[..., 0]

    @property
    def holding(self) -> Float[Array, "*T E"]:
        """Probability that the edge holds."""
        holds = np.array([False, *(each.holds for each in self.edge_types)])
        return jnp.sum(self.type_probability * holds, axis=-1)

    @property
    def contact(self) -> Float[Array, "*T E"]:
        """Probability that the bodies are in contact: that the edge touches or holds."""
        apart = np.array([True, *(not each.contact for each in self.edge_types)])
        return 1.0 - jnp.sum(self.type_probability * apart, axis=-1)

    def over(self, edge_id: Int[Array, " E"] | None, count: int) -> "ContactBelief":
        """The same belief, of one step, over other edges; `count` is the number of all pairs."""
        types = self.type_probability
        inactive = jnp.eye(1, types.shape[-1], dtype=types.dtype)[0]

        def moved(values: Array, unlisted: Array) -> Array:
            if edge_id is None:
                everywhere = jnp.repeat(unlisted[None], count, axis=0)
                return everywhere.at[self.edge_id].set(values, mode="drop")
            if self.edge_id is None:
                row, known = jnp.minimum(edge_id, count - 1), edge_id < count
            elif not len(self.edge_id):
                return jnp.repeat(unlisted[None], len(edge_id), axis=0)
            else:  # Both ascend.
                last = self.edge_id.shape[0] - 1
                row = jnp.minimum(jnp.searchsorted(self.edge_id, edge_id), last)
                known = self.edge_id[row] == edge_id
            known = jnp.expand_dims(known, tuple(range(1, values.ndim)))
            return jnp.where(known, values[row], unlisted)

        if edge_id is None and self.edge_id is None:
            return self
        memory = jax.tree.map(lambda each: moved(each, jnp.zeros_like(each[0])), self.memory)
        return ContactBelief(moved(types, inactive), edge_id, memory, self.edge_types)


def nothing_active(edge_types: tuple[EdgeType, ...]) -> ContactBelief:
    """The belief that surely no edge is active: none is listed."""
    types = jnp.zeros((0, 1 + len(edge_types)))
    return ContactBelief(types, jnp.zeros(0, jnp.int32), edge_types=edge_types)


def two_type_belief(probability: Float[Array, "*T E"]) -> ContactBelief:
    """A belief over {inactive, active} from the probability of *active*."""
    return ContactBelief(jnp.stack([1.0 - probability, probability], axis=-1))


def cast_like(belief: ContactBelief, other: ContactBelief) -> ContactBelief:
    """The belief in the floating type of another, which may be about other edges."""
    dtype = other.type_probability.dtype
    memory = jax.tree.map(lambda each: each.astype(dtype), belief.memory)
    types = belief.type_probability.astype(dtype)
    return dataclasses.replace(belief, type_probability=types, memory=memory)


class ContactSensor(eqx.Module):
    """Error rates of a contact sensor: the same for every edge, or each edge's own.

    The defaults are those of an exact sensor, which no evidence by motion of one step overrules.
    """

    false_alarm: float | Float[Array, " E"] = 1e-5
    """Probability that it reports contact where there is none."""
    miss: float | Float[Array, " E"] = 1e-5
    """Probability that it reports none where there is contact."""
    reports_touch: bool = eqx.field(static=True, default=True)
    """Whether contact is also an edge that only touches; else one that holds."""
    delay: int = eqx.field(static=True, default=0)
    """Steps from a contact to its report."""

    def __check_init__(self) -> None:
        for name in ("false_alarm", "miss"):
            rate = getattr(self, name)
            if isinstance(rate, int | float) and not 0.0 <= rate <= 1.0:
                raise InvalidInputError(f"{name} must be 0 to 1, found {rate}")
        if self.delay < 0:
            raise InvalidInputError(f"delay must be at least 0 steps, found {self.delay}")

    def reports(self, edge_type: EdgeType) -> bool:
        """Whether the sensor means this type by contact."""
        return edge_type.contact if self.reports_touch else edge_type.holds

    def contact_probability(self, belief: ContactBelief) -> Float[Array, "*T E"]:
        """Probability of what the sensor means by contact."""
        return belief.contact if self.reports_touch else belief.holding

    @property
    def as_current(self) -> "ContactSensor":
        """A sensor without delay, for late reports that are taken for current ones."""
        false_alarm, miss = (late_rate(rate, self.delay) for rate in (self.false_alarm, self.miss))
        return ContactSensor(false_alarm, miss, self.reports_touch)


def default_sensor(model: object) -> ContactSensor:
    """The sensor that a model was trained with, where it knows one; else an exact one."""
    return getattr(model, "sensor", None) or ContactSensor()


def late_rate(rate: float | Array, delay: int | Array) -> float | Array:
    """An error rate, or several, that includes changes of contact in the ``delay`` steps since."""
    changed = 0.5 * (1.0 - (1.0 - 2.0 * _CHANGE) ** delay)
    return rate * (1.0 - changed) + (1.0 - rate) * changed


def report_likelihood(
    contact: Float[Array, "*T E"], sensor: ContactSensor, edge_types: tuple[EdgeType, ...]
) -> Float[Array, "*T E K"]:
    """Likelihood of a report, 0 (no contact) to 1 (contact), of each edge type; at least 1e-6."""
    contact, false_alarm, miss = jnp.clip(contact, 0.0, 1.0), sensor.false_alarm, sensor.miss
    if_active = contact * (1.0 - miss) + (1.0 - contact) * miss
    if_inactive = contact * false_alarm + (1.0 - contact) * (1.0 - false_alarm)
    reported = np.array([False, *(sensor.reports(each) for each in edge_types)])
    likelihood = jnp.where(reported, if_active[..., None], if_inactive[..., None])
    return jnp.maximum(likelihood, _MIN_PROBABILITY)


def correct(
    belief: ContactBelief,
    contact_measurement: Float[Array, " all"],
    sensor: ContactSensor,
) -> ContactBelief:
    """Bayes' rule: the posterior belief given a measured contact of bodies that were observed.

    ``contact_measurement`` is 1 (contact), 0 (none), or in between for an uncertain sensor; NaN
    means that the edge was not measured, and leaves its types unchanged. The result is normalised
    and finite even when prior and measurement contradict each other. Paper, eq. (4), with error
    rates in place of a raw distribution. Measurements, and rates that are each edge's own, are of
    all pairs; those of edges that are not listed are ignored.
    """
    if belief.edge_id is not None:
        edge_id = belief.edge_id
        contact_measurement = contact_measurement.at[edge_id].get(mode="fill", fill_value=jnp.nan)
        sensor = jax.tree.map(lambda rate: _listed(rate, edge_id), sensor)
    measured = jnp.isfinite(contact_measurement)
    contact = jnp.where(measured, contact_measurement, 0.5)
    prior = jnp.clip(belief.type_probability, _MIN_PROBABILITY, 1.0)
    posterior = prior * report_likelihood(contact, sensor, belief.edge_types)
    posterior = posterior / jnp.sum(posterior, axis=-1, keepdims=True)
    types = jnp.where(measured[..., None], posterior, belief.type_probability)
    memory = belief.memory.after_report(belief.type_probability, types)
    return dataclasses.replace(belief, type_probability=types, memory=memory)


def _listed(rate: float | Array, edge_id: Int[Array, " E"]) -> float | Array:
    return rate if jnp.ndim(rate) == 0 else jnp.asarray(rate).at[edge_id].get(mode="clip")


def spread_over_types(active: Float[Array, " E"], active_types: int) -> Float[Array, "E K"]:
    """Probabilities of the types: that of any active one is spread evenly over the active ones."""
    spread = jnp.repeat(active[:, None] / active_types, active_types, axis=-1)
    return jnp.concatenate([1.0 - active[:, None], spread], axis=-1)


def without_change(predicted: ContactBelief) -> tuple[ContactBelief, Float[Array, "E K K"]]:
    """A prediction as of `EdgeInference.predict`, where no edge changes its type within the step.

    Of the pairs of types no equal one is less probable than 0.01: beyond their data networks are
    overconfident.
    """
    count = predicted.type_probability.shape[-1]
    types = jnp.clip(predicted.type_probability, _LEAST_TYPE, 1.0 - (count - 1) * _LEAST_TYPE)
    return predicted, types[:, :, None] * jnp.eye(count, dtype=types.dtype)


def posterior_by_motion(
    predicted: ContactBelief, joint: Float[Array, "E K K"], log_ratios: Float[Array, "E K K"]
) -> ContactBelief:
    """The belief corrected by `edge_log_ratios`; bit for bit as predicted where these are 0.

    ``joint`` is the probability of the pairs of types that is predicted with it.
    """
    pairs = pair_posterior(joint, log_ratios)
    evidence = jnp.any(log_ratios != 0, axis=(1, 2))[:, None]
    after = jnp.where(evidence, jnp.sum(pairs, axis=1), predicted.type_probability)
    memory = predicted.memory.after_motion(joint, pairs, evidence)
    return dataclasses.replace(predicted, type_probability=after, memory=memory)


def pair_posterior(
    joint: Float[Array, "*E K K"], log_ratios: Float[Array, "*E K K"]
) -> Float[Array, "*E K K"]:
    """Bayes' rule: the probability of each pair of types."""
    return jax.nn.softmax(jnp.log(jnp.maximum(joint, _MIN_JOINT)) + log_ratios, axis=(-2, -1))


def likeliest_type(type_probability: Float[Array, "*T K"]) -> Int[Array, "*T"]:
    """Free where that is at least as probable as all active types together, else the likeliest.

    Touch and hold are the same motion while bodies are pressed together. Were each compared with
    *free* alone, doubt between the two would part bodies that are probably in contact.
    """
    active = 1 + jnp.argmax(type_probability[..., 1:], axis=-1)
    return jnp.where(type_probability[..., 0] >= 0.5, 0, active)


class ArgmaxSample(eqx.Module):
    """`likeliest_type`; the gradient passes straight through to the probability."""

    def __call__(
        self, type_probability: Float[Array, "*T E K"], key: PRNGKeyArray | None
    ) -> Float[Array, "*T E K"]:
        """One-hot edge types. No key is needed."""
        return _straight_through(type_probability, likeliest_type(type_probability))


class GumbelSample(eqx.Module):
    """A sample of the probability (Gumbel-max), straight through to a softened sample.

    Without a key it is the `likeliest_type`, so that plans are deterministic.
    """

    temperature: float = eqx.field(static=True, default=1.0)

    def __call__(
        self, type_probability: Float[Array, "*T E K"], key: PRNGKeyArray | None
    ) -> Float[Array, "*T E K"]:
        """One-hot edge types."""
        if key is None:
            return _straight_through(type_probability, likeliest_type(type_probability))
        logits = jnp.log(jnp.clip(type_probability, _MIN_PROBABILITY, 1.0))
        noisy = logits + jax.random.gumbel(key, logits.shape, logits.dtype)
        # Where the soft sample is used the probability itself must not gain mass at exactly 0.
        noisy = jnp.where(type_probability > 0, noisy, -jnp.inf)
        drawn = jnp.argmax(noisy, axis=-1)
        return _straight_through(jax.nn.softmax(noisy / self.temperature, axis=-1), drawn)


def _straight_through(soft: Array, index: Array) -> Array:
    hard = jax.nn.one_hot(index, soft.shape[-1], dtype=soft.dtype)
    return hard + soft - jax.lax.stop_gradient(soft)
