"""From a probability over edge types to one type, differentiably."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


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
