"""The paper's head: from node embeddings to free parameters of every node."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.model.local_input import LocalInput, Step
from contactgraph.model.spring_mass_damper import SpringMassDamper, own_component


class PerDegreeHead(eqx.Module):
    """The paper's head: 1/m, k, c and equilibrium of every node and degree of freedom, freely.

    The equilibrium is relative to the node's hinge, or, where it has none, to its own position.
    Parameters are positive.
    """

    node: eqx.nn.MLP
    width: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, width: int, dimension: int, *, key: PRNGKeyArray):
        self.node = eqx.nn.MLP(width, 4 * dimension, width, 2, key=key)
        self.width = width
        self.dimension = dimension

    def __call__(
        self,
        local: LocalInput,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        step: Step,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        out = jax.vmap(self.node)(embedding).reshape(-1, 4, self.dimension)
        origin = local.position
        if local.anchor is not None:
            origin = jnp.where(jnp.isfinite(local.anchor), local.anchor, origin)
        return SpringMassDamper(
            response=own_component(5.0 * jax.nn.sigmoid(out[:, 0]), step.control_size),
            stiffness_rate=5.0 * jax.nn.sigmoid(out[:, 1]),
            damping_rate=5.0 * jax.nn.sigmoid(out[:, 2]),
            equilibrium=origin + out[:, 3],
            equilibrium_velocity=jnp.zeros_like(origin),
            shift=jnp.zeros_like(origin),
        )
