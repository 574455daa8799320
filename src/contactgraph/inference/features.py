"""Features of nodes and edges, the inputs of networks; prior and weight of edges by distance."""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from contactgraph.bodies.geometry import Geometry, Meeting
from contactgraph.bodies.pins import apart_from_pins
from contactgraph.bodies.polygons import polygon_meeting
from contactgraph.bodies.shapes import meeting
from contactgraph.data.trajectory_batch import Nodes, type_id

_NEAR = 0.03
"""Gap, in contact distances, that separates bodies that touch from those that are merely near."""
_PACE = 5.0
"""Scale of the logarithms of sizes in their parameters, so that they learn as fast as networks."""
_TOUCHING, GAP_SCALES = 0.002, (0.003, 0.03, 0.3)
"""Gap, in contact distances, of bodies that touch, at most, and approach in a step of such that
rest; and those gaps beyond it at which bodies have just parted, are merely near, and are apart."""


class Features(eqx.Module):
    """Features of nodes and edges; the defaults are those of round bodies of unnamed types."""

    contact_distance: eqx.AbstractVar[Float[Array, ""] | float]
    """m, centre to centre, or to a bar's middle line."""
    speed: float = eqx.field(static=True, default=1.0, kw_only=True)
    """Unit of speeds, m/s."""
    types: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    """Names of the node types, passive ones first."""
    boxes: bool = eqx.field(static=True, default=False, kw_only=True)
    """Whether nodes that have a size are boxes along the axes."""
    turn_length: float | None = eqx.field(static=True, default=None, kw_only=True)
    """See `generalized_coordinates`, m. None: no body turns."""

    @property
    def hinges(self) -> bool | None:
        """Whether bodies are on hinges. None: whether or not."""
        return None

    @abstractmethod
    def node_type(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, "N node_types"]:
        """One-hot."""

    @abstractmethod
    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""

    @abstractmethod
    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""

    @abstractmethod
    def edge(self, geometry: Geometry) -> Float[Array, "2 E F"]:
        """Features of every edge, for the messages to its first and to its second node."""

    def turns(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, " N"]:
        """1 for bodies that turn, else 0."""
        return jnp.zeros(nodes.mask.shape, dtype)

    def meeting(
        self, nodes: Nodes, position: Float[Array, "N G"], edge_index: Int[Array, "2 E"]
    ) -> Meeting:
        """The places at which nodes `shaped` meet."""
        return meeting(position, edge_index, nodes.anchor, nodes.half_size)

    def distances(
        self, nodes: Nodes, edge_index: Int[Array, "2 E"], dtype: DTypeLike
    ) -> Float[Array, "*E"] | float:
        """The contact distance of every edge, m, or one for all."""
        return self.contact_distance


class InvariantFeatures(Features):
    """Features that no rotation, reflection or translation of the scene changes.

    Node: its type and its speed. Edge: the
    bounded gaps between the two bodies, now and at closest approach in the step; the distance; the
    fraction of the step after an impact. Relative speeds are left out, because predicted distances
    carry what matters of them, so that a speed absent from training is nothing new. The contact
    distance is `length` [m], or is learned starting from it; `length` and `speed` [m/s] are the
    units of distances and speeds.
    """

    contact_distance: Float[Array, ""] | float
    """m, centre to centre, or to a bar's middle line; a plain number where it is not learned."""
    log_size: Float[Array, " types"] | None
    """Logarithm of each type's part of the contact distance, in units of `_PACE`; 0: half of it.
    None: types have no names."""
    length: float = eqx.field(static=True)
    learned: bool = eqx.field(static=True)
    turning: tuple[str, ...] = eqx.field(static=True)
    margin: float = eqx.field(static=True)

    def __init__(
        self,
        length: float = 0.1,
        speed: float = 1.0,
        learned: bool = True,
        types: tuple[str, ...] = (),
        boxes: bool = False,
        turning: tuple[str, ...] = (),
        turn_length: float | None = None,
        margin: float = 0.0,
    ):
        """`learned`: whether the contact distance is.

        It is identified by impacts within one step, not by a grasp that takes several steps.
        `types`: names of the node types, passive ones first, actuated ones last; without names,
        bodies are of one size, and their types are whether they are actuated.
        `boxes`: whether nodes that have a size are boxes; see `box_displacement`.
        `turning`: the types of bodies that turn; `turn_length` [m]: see `generalized_coordinates`,
        None where none does. `margin`: gap at which two outlines touch, m.
        """
        # A product has no weak type, with which the first training update would recompile.
        self.contact_distance = length * jnp.ones(()) if learned else length
        self.length = length
        self.speed = speed
        self.learned = learned
        self.types = types
        self.boxes = boxes
        self.turning = turning
        self.turn_length = turn_length
        self.margin = margin
        self.log_size = 0.0 * jnp.ones(len(types)) if types else None

    @property
    def node_types(self) -> int:
        """Number of node types."""
        return len(self.types) or 2

    def node_type(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, "N node_types"]:
        """One-hot, by name; without names: actuated or not.

        Nodes whose types are not told have the first, actuated ones the last.
        """
        if not self.types:
            return jax.nn.one_hot(nodes.actuated.astype(int), 2, dtype=dtype)
        if nodes.type_id is None:
            index = jnp.where(nodes.actuated, len(self.types) - 1, 0)
            return jax.nn.one_hot(index, len(self.types), dtype=dtype)
        known = np.array([type_id(name) for name in self.types])
        return (nodes.type_id[:, None] == known).astype(dtype)

    def turns(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, " N"]:
        """1 for bodies that turn, else 0."""
        if not self.turning:
            return jnp.zeros(nodes.mask.shape, dtype)
        of_type = np.array([name in self.turning for name in self.types], dtype)
        return self.node_type(nodes, dtype) @ of_type * nodes.mobile

    def meeting(
        self, nodes: Nodes, position: Float[Array, "N G"], edge_index: Int[Array, "2 E"]
    ) -> Meeting:
        """The places at which nodes `shaped` meet, of which those never move that the scene says,
        where types have names."""
        if self.turn_length is None or nodes.outlines is None:
            found = meeting(position, edge_index, nodes.anchor, nodes.half_size)
        else:
            found = polygon_meeting(
                nodes.outlines,
                position,
                self.turns(nodes, position.dtype),
                edge_index,
                turn_length=self.turn_length,
                length=self.length,
                margin=self.margin,
            )
        return found.with_fixed(nodes.static if self.types else None)

    def distances(
        self, nodes: Nodes, edge_index: Int[Array, "2 E"], dtype: DTypeLike
    ) -> Float[Array, "*E"] | float:
        """The contact distance of every edge, m: one for all where types have no names."""
        if self.log_size is None:
            return self.contact_distance
        log_size = self.log_size if self.learned else jax.lax.stop_gradient(self.log_size)
        size = jnp.exp(_PACE * self.node_type(nodes, dtype) @ log_size)
        return 0.5 * self.contact_distance * jnp.sum(size[edge_index], axis=0)

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
        speed = jnp.sqrt(jnp.sum((velocity / self.speed) ** 2, axis=-1) + 1e-12)
        bounded = (speed / (1.0 + speed))[:, None]
        return jnp.concatenate([self.node_type(nodes, speed.dtype), bounded], axis=-1)

    def edge(self, geometry: Geometry) -> Float[Array, "2 E F"]:
        """Features of every edge, for the messages to its first and to its second node."""
        # The contact distance is learned from the time of impacts alone.
        touch = jax.lax.stop_gradient(geometry.contact_distance)[:, None]
        gaps = jnp.stack([geometry.distance, geometry.closest_approach], axis=-1) / touch - 1.0
        # A few hundredths of the distance separate touching from near.
        close = gaps / (_NEAR + jnp.abs(gaps))
        distance = geometry.distance[:, None] / self.length - 1.0
        after_impact = geometry.fraction_after_impact[:, None]
        features = jnp.concatenate([close, distance, after_impact], axis=-1)
        return jnp.stack([features, features])


def pull_approach_gap_and_switches(
    geometry: Geometry,
    nodes: Nodes,
    control: Float[Array, " U"],
    displacement: Float[Array, "N G"] | None,
    switches: int,
) -> Float[Array, "E 5+C"]:
    """By how many contact distances the control drives actuated ends away from the other ones, by
    ``displacement`` m; 1 where bodies approach each other in the step, else 0; their bounded gap
    before it, on the scales, negative where one is in the other; and the ``switches``, which come
    last in the control, of actuated ends."""
    touch = jax.lax.stop_gradient(geometry.contact_distance)
    gap = geometry.distance[:, None] / touch[:, None] - 1.0
    gap = jnp.sign(gap) * jnp.maximum(jnp.abs(gap) - _TOUCHING, 0.0)
    approaches = (geometry.distance - geometry.closest_approach) / touch > _TOUCHING
    actuated, size = nodes.actuated[geometry.edge_index], geometry.direction.shape[1]
    driven = 0.0 if displacement is None else displacement[geometry.edge_index, :size]
    pull = jnp.diff(actuated * jnp.sum(geometry.direction * driven, axis=-1), axis=0)[0] / touch
    acting = jnp.sum(actuated, axis=0)[:, None] * control[len(control) - switches :]
    bounded = gap / (np.array(GAP_SCALES) + jnp.abs(gap))
    return jnp.concatenate([pull[:, None], approaches[:, None], bounded, acting], axis=-1)


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.003)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.002)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.0001)
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

    outer: float = eqx.field(static=True, default=math.inf)
    """m"""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)


def turn_length_of(model: object) -> float | None:
    """The unit of turns, m, of a model of bodies that turn: see `generalized_coordinates`."""
    return getattr(getattr(model, "features", None), "turn_length", None)


def shaped(nodes: Nodes, features: Features, dimension: int) -> Nodes:
    """The nodes with those shapes that a model of such features uses."""
    if not features.boxes:
        nodes = nodes._replace(half_size=None)
    if features.turn_length is None:
        return nodes._replace(outlines=None, pins=None)
    nodes = apart_from_pins(nodes)
    points = jnp.zeros((len(nodes.mask), 1, 1, *((2,) if dimension == 2 else (5, 3))))
    return nodes._replace(outlines=points if nodes.outlines is None else nodes.outlines)
