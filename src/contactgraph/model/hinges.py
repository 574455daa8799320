"""Bodies on hinges: bars that turn about a fixed point."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_SMALLEST = 1e-12


class Bars(eqx.Module):
    """Nodes of which some hang on hinges, at one step.

    A hinged node is taken for the middle of a straight bar that begins at its hinge. Bars turn
    rigidly, so the velocity of the node tells that of every point that turns with it.
    """

    position: Float[Array, "N D"]
    """m"""
    hinged: Bool[Array, " N"]
    anchor: Float[Array, "N D"]
    """m; zero where there is no hinge."""
    arm: Float[Array, "N D"]
    """From the hinge to the node, m; of length 1 where there is no hinge."""

    def __init__(self, position: Float[Array, "N D"], anchor: Float[Array, "N D"]):
        """`anchor` is NaN where a node has no hinge."""
        self.position = position
        self.hinged = jnp.isfinite(anchor[:, 0])
        self.anchor = jnp.where(self.hinged[:, None], anchor, 0.0)
        unit = jnp.zeros_like(position).at[:, 0].set(1.0)
        self.arm = jnp.where(self.hinged[:, None], position - self.anchor, unit)

    @property
    def arm_squared(self) -> Float[Array, " N"]:
        """Squared length of the arm, m^2."""
        return jnp.maximum(jnp.sum(self.arm**2, axis=-1), _SMALLEST)

    def nearest(
        self, node: Int[Array, " E"], point: Float[Array, "E D"]
    ) -> tuple[Float[Array, "E D"], Float[Array, "E D"]]:
        """The bars' points nearest to `point` [m], and the directions in which they may slide.

        A direction is the bar's own (a unit vector) where the nearest point lies inside the bar,
        and zero at its ends and for nodes without a hinge, whose only point is their own.
        """
        arm, squared = self.arm[node], self.arm_squared[node]
        fraction = jnp.sum((point - self.anchor[node]) * arm, axis=-1) / squared
        inside = self.hinged[node] & (fraction > 0.0) & (fraction < 2.0)
        on_bar = self.anchor[node] + jnp.clip(fraction, 0.0, 2.0)[:, None] * arm
        along = arm / jnp.sqrt(squared)[:, None]
        return (
            jnp.where(self.hinged[node][:, None], on_bar, self.position[node]),
            jnp.where(inside[:, None], along, 0.0),
        )

    def lever(self, node: Int[Array, " E"], point: Float[Array, "E D"]) -> Float[Array, "E D D"]:
        r"""The matrix L that takes a node's velocity to that of the material at `point` [m].

        With arm $r$ and $b$ from the hinge to the point, $L = (r \cdot b\, I - r b^T) / r^2$; the
        identity for nodes without a hinge. Its transpose takes a force at the point to the node,
        and leaves nothing of it along the arm, which the hinge bears.
        """
        arm, reach = self.arm[node], point - self.anchor[node]
        identity = jnp.eye(point.shape[-1], dtype=point.dtype)
        turning = jnp.sum(arm * reach, axis=-1)[:, None, None] * identity
        turning = turning - arm[:, :, None] * reach[:, None, :]
        turning = turning / self.arm_squared[node][:, None, None]
        return jnp.where(self.hinged[node][:, None, None], turning, identity)
