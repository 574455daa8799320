"""How far an edge can be active: what makes the model local."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry


class Reach(eqx.Module):
    """How far an edge can be active: weight 1 below `near` [m], exactly 0 from `far` [m] on.

    What is out of reach of everything changes nobody's prediction, exactly.
    """

    near: float = eqx.field(static=True, default=0.15)
    far: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1]."""
        fraction = (self.far - geometry.nearest) / (self.far - self.near)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class Everywhere(eqx.Module):
    """No limit to an edge's reach: the paper's all-pairs inference."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)
