"""What distance alone says about contact."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry


class DistancePrior(eqx.Module):
    r"""Probability of contact from the distance $d$ of two nodes and a threshold $d_{th}$.

    $$ q = \sigma\big( 2 (d_{th} - d) / s \big), \qquad
       s = s_\text{inside}\ (d < d_{th}),\ s_\text{outside}\ (d \ge d_{th}) $$

    With both scales 1 m and no look-ahead this is the paper's prior. With look-ahead $d$ is the
    smaller of the distances now and one step ahead, because the edge of a step must already be
    active when the bodies touch *within* it.
    """

    threshold: float = eqx.field(static=True, default=0.1)
    """d_th, m."""
    inside: float = eqx.field(static=True, default=0.02)
    """Scale below the threshold, m."""
    outside: float = eqx.field(static=True, default=0.05)
    """Scale above the threshold, m."""
    look_ahead: bool = eqx.field(static=True, default=True)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        distance = geometry.nearest if self.look_ahead else geometry.distance
        margin = self.threshold - distance
        scale = jnp.where(margin > 0, self.inside, self.outside)
        return jax.nn.sigmoid(2.0 * margin / scale)
