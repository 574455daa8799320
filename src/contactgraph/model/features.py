"""What the networks see of nodes and edges."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry
from contactgraph.model.state import Nodes


class InvariantFeatures(eqx.Module):
    """Features that no rotation, reflection or translation of the scene changes.

    Node: actuated or not, speed. Edge: distance now and one step ahead, closing and sideways
    speed, and the share of the step that follows the touch. All but the distances are bounded,
    so that a speed never seen in training is not far from those that were. The distance at which
    bodies touch is learned; lengths are measured in `length` [m], speeds in `speed` [m/s].
    """

    touch_distance: Float[Array, ""]
    """m, centre to centre; learned."""
    length: float = eqx.field(static=True)
    speed: float = eqx.field(static=True)

    def __init__(self, length: float = 0.1, speed: float = 1.0):
        # A product, so that its type is not weak: else the first update of training recompiles.
        self.touch_distance = length * jnp.ones(())
        self.length = length
        self.speed = speed

    def node_size(self, dimension: int) -> int:
        """Number of features a node."""
        return 2

    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""
        return 5

    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""
        speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-12) / self.speed
        return jnp.stack([nodes.actuated.astype(speed.dtype), speed / (1.0 + speed)], axis=-1)

    def edge(self, geometry: Geometry) -> Float[Array, "2 E F"]:
        """Features of every edge, for the message to its first and to its second node."""
        relative = geometry.relative_velocity
        closing = -jnp.sum(relative * geometry.direction, axis=-1)
        sideways = relative + closing[:, None] * geometry.direction
        sideways = jnp.sqrt(jnp.sum(sideways**2, axis=-1) + 1e-12) / self.speed
        closing = closing / self.speed
        features = jnp.stack(
            [
                geometry.distance / self.length - 1.0,
                geometry.coming_distance / self.length - 1.0,
                closing / (1.0 + jnp.abs(closing)),
                sideways / (1.0 + sideways),
                geometry.share_after_touch,
            ],
            axis=-1,
        )
        return jnp.stack([features, features])


class AbsoluteFeatures(eqx.Module):
    """The paper's own: position, velocity and actuated flag of a node; distance of an edge."""

    touch_distance: float = eqx.field(static=True, default=0.1)
    """m, centre to centre; these features do not use it."""

    def node_size(self, dimension: int) -> int:
        """Number of features a node."""
        return 2 * dimension + 1

    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""
        return 1

    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""
        actuated = nodes.actuated.astype(position.dtype)[:, None]
        return jnp.concatenate([position, velocity, actuated], axis=-1)

    def edge(self, geometry: Geometry) -> Float[Array, "2 E F"]:
        """Features of every edge, for the message to its first and to its second node."""
        features = geometry.distance[:, None]
        return jnp.stack([features, features])
