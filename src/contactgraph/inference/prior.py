"""Edges by distance: their prior, and their weight."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.03)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.02)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.01)
    r"""$\epsilon$."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(geometry.contact_distance)
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        spread = 1.0 - 2.0 * self.min_probability
        return self.min_probability + spread * jax.nn.sigmoid(2.0 * margin)


class SmoothCutoff(eqx.Module):
    """Weight of an edge by distance: 1 below `inner` [m], exactly 0 from `outer` [m] on.

    A node beyond the cutoff of all others changes no prediction of theirs, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1], by its closest approach in the step."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """Weight 1 at every distance: the paper's all-pairs inference."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)
