"""What the networks see of nodes and edges."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from contactgraph.model.collision import Geometry
from contactgraph.model.types import Nodes

_NEAR = 0.03
"""Gap, in distances of touch, that tells bodies which touch from those which are merely near."""


class InvariantFeatures(eqx.Module):
    """Features that no rotation, reflection or translation of the scene changes.

    Node: its kind (actuated or not, hinged or not where there are hinges), speed. Edge: the gaps
    between the two bodies, now and where they come nearest in the coming step, bounded; the
    distance; the share of the step that follows the touch. Speeds of edges are none of it: what is
    coming tells of them what matters, so a speed never seen in training is nothing new. The
    distance at which bodies touch is `length` [m], in which distances are measured, or learned from
    there on; speeds are measured in `speed` [m/s].
    """

    contact_distance: Float[Array, ""] | float
    """m, centre to centre, or to a bar's middle line; a plain number where it is not learned."""
    length: float = eqx.field(static=True)
    speed: float = eqx.field(static=True)
    hinges: bool = eqx.field(static=True)
    learned: bool = eqx.field(static=True)

    def __init__(
        self,
        length: float = 0.1,
        speed: float = 1.0,
        hinges: bool = False,
        learned: bool = True,
    ):
        """`hinges`: whether nodes may hang on hinges; `learned`: whether the distance of touch is.

        Impacts within one step tell it; a grasp that takes several steps does not.
        """
        # A product, so that its type is not weak: else the first update of training recompiles.
        self.contact_distance = length * jnp.ones(()) if learned else length
        self.length = length
        self.speed = speed
        self.hinges = hinges
        self.learned = learned

    @property
    def node_types(self) -> int:
        """Number of node types."""
        return 4 if self.hinges else 2

    def node_type(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, "N node_types"]:
        """One-hot: actuated or not; times hinged or not, where there are hinges."""
        return _kind(nodes, self.hinges, dtype)

    def node_size(self, dimension: int) -> int:
        """Number of features a node."""
        return self.node_types + 1

    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""
        return 4

    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""
        speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-12) / self.speed
        bounded = (speed / (1.0 + speed))[:, None]
        return jnp.concatenate([self.node_type(nodes, speed.dtype), bounded], axis=-1)

    def edge(
        self, geometry: Geometry, contact_distance: Float[Array, " E"] | None = None
    ) -> Float[Array, "2 E F"]:
        """Features of every edge, for the message to its first and to its second node.

        `contact_distance` [m] is each edge's own; None: that of all.
        """
        # The distance of touch is learned from the impacts' timing alone.
        touch = jax.lax.stop_gradient(self.contact_distance)
        touch = touch if contact_distance is None else contact_distance[:, None]
        gaps = jnp.stack([geometry.distance, geometry.closest_approach], axis=-1) / touch - 1.0
        # Touching or merely near: a few hundredths of the distance decide.
        close = gaps / (_NEAR + jnp.abs(gaps))
        distance = geometry.distance[:, None] / self.length - 1.0
        share = geometry.fraction_after_impact[:, None]
        features = jnp.concatenate([close, distance, share], axis=-1)
        return jnp.stack([features, features])


class AbsoluteFeatures(eqx.Module):
    """The paper's own: position, velocity and actuated flag of a node; distance of an edge."""

    contact_distance: float = eqx.field(static=True, default=0.1)
    """m, centre to centre; these features do not use it."""
    hinges: bool = eqx.field(static=True, default=False)
    """Whether nodes may hang on hinges; the way from the hinge is a feature then."""

    @property
    def node_types(self) -> int:
        """Number of node types."""
        return 4 if self.hinges else 2

    def node_type(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, "N node_types"]:
        """One-hot: actuated or not; times hinged or not, where there are hinges."""
        return _kind(nodes, self.hinges, dtype)

    def node_size(self, dimension: int) -> int:
        """Number of features a node."""
        return 2 * dimension + self.node_types + self.hinges * dimension

    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""
        return 1

    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""
        features = [position, velocity, self.node_type(nodes, position.dtype)]
        if self.hinges and nodes.anchor is not None:
            hinged = nodes.hinged[:, None]
            features.append(jnp.where(hinged, position - jnp.nan_to_num(nodes.anchor), 0.0))
        elif self.hinges:
            features.append(jnp.zeros_like(position))
        return jnp.concatenate(features, axis=-1)

    def edge(
        self, geometry: Geometry, contact_distance: Float[Array, " E"] | None = None
    ) -> Float[Array, "2 E F"]:
        """Features of every edge, for the message to its first and to its second node."""
        features = geometry.distance[:, None]
        return jnp.stack([features, features])


def _kind(nodes: Nodes, hinges: bool, dtype: DTypeLike) -> Float[Array, "N node_types"]:
    kind = nodes.actuated.astype(int)
    if hinges:
        kind = kind + 2 * nodes.hinged.astype(int)
    return jax.nn.one_hot(kind, 4 if hinges else 2, dtype=dtype)
