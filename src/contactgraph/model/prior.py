"""What distance alone says about contact."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry


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
        self, geometry: Geometry, touch_distance: Float[Array, ""] | float
    ) -> Float[Array, " E"]:
        """Prior probability that each edge is active; `touch_distance` has no say."""
        margin = self.threshold - geometry.distance
        scale = jnp.where(margin > 0, self.inside, self.outside)
        return jax.nn.sigmoid(2.0 * margin / scale)


class TouchPrior(eqx.Module):
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
    doubt: float = eqx.field(static=True, default=0.01)
    """epsilon."""

    def __call__(
        self, geometry: Geometry, touch_distance: Float[Array, ""] | float
    ) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(jnp.asarray(touch_distance))
        margin = (self.margin * touch - geometry.nearest) / (self.sharpness * touch)
        return self.doubt + (1.0 - 2.0 * self.doubt) * jax.nn.sigmoid(2.0 * margin)
