"""Probabilities of pairs of edge types: at the start of a step, and in its end."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.contact_belief import ContactBelief

_MIN_PROBABILITY = 1e-6
_MIN_JOINT = 1e-12
_UNBOUNDED = 0.1
"""Share of the gradient that is kept beyond the least transition."""


def bounded_softmax(logits: Float[Array, "E K K"], least: float) -> Float[Array, "E K K"]:
    """Softmax, at least ``least``; a part of its gradient is that without the bound.

    Beyond the bound logits have no effect, and without any gradient they would never return.
    """
    unbounded = jax.nn.log_softmax(logits)
    bounded = least + (1.0 - logits.shape[-1] * least) * jnp.exp(unbounded)
    return bounded * jnp.exp(_UNBOUNDED * (unbounded - jax.lax.stop_gradient(unbounded)))


def kept_share(joint: Float[Array, "E K K"]) -> Float[Array, "E active"]:
    """Probability that an edge had an active type before, too, if it has it now.

    No gradient is taken: that of improbable types has no bound.
    """
    joint = jax.lax.stop_gradient(joint)
    kept = jnp.einsum("eii->ei", joint)
    return (kept / jnp.maximum(jnp.sum(joint, axis=1), _MIN_PROBABILITY))[:, 1:]


def without_change(predicted: ContactBelief, error_floor: float = 0.0) -> Float[Array, "E K K"]:
    """The probability of the pairs of types where no edge changes its type within the step.

    No type is less probable than ``error_floor``: beyond their data networks are overconfident.
    """
    most = 1.0 - (predicted.edge_types - 1) * error_floor
    types = jnp.clip(predicted.type_probability, error_floor, most)
    return types[:, :, None] * jnp.eye(predicted.edge_types, dtype=types.dtype)


def posterior_by_motion(
    predicted: ContactBelief, joint: Float[Array, "E K K"], log_ratios: Float[Array, "E K K"]
) -> ContactBelief:
    """The belief corrected by `edge_log_ratios`; bit for bit as predicted where these are 0.

    ``joint`` is the probability of the pairs of types that is predicted with it. Motion that speaks
    for a change makes an age small.
    """
    pairs = pair_posterior(joint, log_ratios)
    evidence = jnp.any(log_ratios != 0, axis=(1, 2))[:, None]
    after = jnp.where(evidence, jnp.sum(pairs, axis=1), predicted.type_probability)
    memory, active = predicted.memory, joint.shape[-1] - 1
    if memory is not None and memory.shape[-1] > active:
        kept = kept_share(pairs) / jnp.maximum(kept_share(joint), _MIN_PROBABILITY)
        age = memory[:, -active:]
        age = jnp.where(evidence, 1.0 + (age - 1.0) * kept, age)
        memory = memory.at[:, -active:].set(age.astype(memory.dtype))
    return ContactBelief(after, predicted.edge_id, memory)


def pair_posterior(
    joint: Float[Array, "*E K K"], log_ratios: Float[Array, "*E K K"]
) -> Float[Array, "*E K K"]:
    """Bayes' rule: the probability of each pair of types."""
    return jax.nn.softmax(jnp.log(jnp.maximum(joint, _MIN_JOINT)) + log_ratios, axis=(-2, -1))
