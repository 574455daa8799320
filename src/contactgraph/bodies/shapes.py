"""Shapes of bodies: the places at which balls, bars about hinges, and boxes meet."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import Meeting

_MIN_SQUARE = 1e-12
_LEAST_GAP = 1e-6
"""Of a distance from a box, in units of its sides, below which a point counts as inside."""


def meeting(
    position: Float[Array, "N D"],
    edge_index: Int[Array, "2 E"],
    anchor: Float[Array, "N D"] | None = None,
    half_size: Float[Array, "N D"] | None = None,
) -> Meeting:
    """The places of round bodies, of bars about an ``anchor`` [m] and of boxes along the axes."""
    at_ends = position[edge_index]
    jacobian, sliding = jnp.ones((*edge_index.shape, 1, 1), position.dtype), []
    if anchor is not None:
        bodies, others = HingedBodies(position, anchor), at_ends[::-1]
        jacobian = bodies.contact_jacobian(edge_index, others)
        at_ends, along = bodies.closest_point(edge_index, others)
        sliding = list(along)
    displacement = at_ends[1] - at_ends[0]
    if half_size is not None:
        half_size = jnp.sum(half_size[edge_index], axis=0)
        displacement, sliding = box_displacement(displacement, half_size)
    return Meeting(edge_index, jacobian, displacement, sliding)


class HingedBodies(eqx.Module):
    """Geometry of the nodes at one step, some of which are hinged.

    A hinged node is the middle of a straight bar that begins at its hinge. Bars are rigid, so the
    velocity of the node determines that of every point that turns with it.
    """

    position: Float[Array, "N D"]
    """m"""
    hinged: Bool[Array, " N"]
    anchor: Float[Array, "N D"]
    """m; zero where there is no hinge."""
    radius_vector: Float[Array, "N D"]
    """From the hinge to the node, m; of length 1 where there is no hinge."""

    def __init__(self, position: Float[Array, "N D"], anchor: Float[Array, "N D"]):
        """`anchor` is NaN where a node has no hinge."""
        self.position = position
        self.hinged = jnp.isfinite(anchor[:, 0])
        self.anchor = jnp.where(self.hinged[:, None], anchor, 0.0)
        unit = jnp.zeros_like(position).at[:, 0].set(1.0)
        self.radius_vector = jnp.where(self.hinged[:, None], position - self.anchor, unit)

    @property
    def radius_squared(self) -> Float[Array, " N"]:
        """Squared length of the radius vector, m^2."""
        return jnp.maximum(jnp.sum(self.radius_vector**2, axis=-1), _MIN_SQUARE)

    def closest_point(
        self, node: Int[Array, "*C"], point: Float[Array, "*C D"]
    ) -> tuple[Float[Array, "*C D"], Float[Array, "*C D"]]:
        """The bars' points closest to `point` [m], and the directions in which they may slide.

        A direction is the bar's own (a unit vector) where the closest point lies inside the bar,
        and zero at its ends and for nodes without a hinge, which have only their own point.
        """
        radius, squared = self.radius_vector[node], self.radius_squared[node]
        fraction = jnp.sum((point - self.anchor[node]) * radius, axis=-1) / squared
        inside = self.hinged[node] & (fraction > 0.0) & (fraction < 2.0)
        on_bar = self.anchor[node] + jnp.clip(fraction, 0.0, 2.0)[..., None] * radius
        along = radius / jnp.sqrt(squared)[..., None]
        return (
            jnp.where(self.hinged[node][..., None], on_bar, self.position[node]),
            jnp.where(inside[..., None], along, 0.0),
        )

    def contact_jacobian(
        self, node: Int[Array, "*C"], point: Float[Array, "*C D"]
    ) -> Float[Array, "*C D D"]:
        r"""The matrix J that maps a node's velocity to that of its material at `point` [m].

        With radius vector $r$ and $b$ from the hinge to the point,
        $J = (r \cdot b\, I - r b^T) / r^2$; the identity for nodes without a hinge. Its transpose
        maps a force at the point to the node, without the part along $r$, which the hinge bears.
        """
        radius, to_point = self.radius_vector[node], point - self.anchor[node]
        identity = jnp.eye(point.shape[-1], dtype=point.dtype)
        turning = jnp.sum(radius * to_point, axis=-1)[..., None, None] * identity
        turning = turning - radius[..., :, None] * to_point[..., None, :]
        turning = turning / self.radius_squared[node][..., None, None]
        return jnp.where(self.hinged[node][..., None, None], turning, identity)


def box_displacement(
    displacement: Float[Array, "E D"], half_size: Float[Array, "E D"]
) -> tuple[Float[Array, "E D"], list[Float[Array, "E D"]]]:
    r"""The displacement of a point from a box as if that were a ball, and directions of sliding.

    ``displacement`` [m] is that from the box's centre; of two boxes, ``half_size`` [m] is the sum
    of both. With $n$ the unit vector from the nearest point of the box, $g$ the distance from there
    (negative within the box) and $r$ half of its shortest side, the result is $(g + r) n$: on that
    side, as far as the centre is. A point before a side slides along it (unit vectors, else 0)
    without coming nearer. Where ``half_size`` is 0 the displacement stays as it is.
    """
    beyond = jnp.abs(displacement) - half_size
    sign = jnp.where(displacement < 0.0, -1.0, 1.0)
    outside = sign * jnp.maximum(beyond, 0.0)
    square = jnp.sum(outside**2, axis=-1, keepdims=True)
    inside = square <= (_LEAST_GAP * jnp.min(half_size, axis=-1, keepdims=True)) ** 2
    gap = jnp.sqrt(jnp.where(inside, 1.0, square))
    nearest_side = beyond == jnp.max(beyond, axis=-1, keepdims=True)
    normal = jnp.where(inside, sign * nearest_side, outside / gap)
    gap = jnp.where(inside, jnp.max(beyond, axis=-1, keepdims=True), gap)
    is_box = jnp.any(half_size > 0.0, axis=-1, keepdims=True)
    radius = jnp.min(half_size, axis=-1, keepdims=True)
    moved = jnp.where(is_box, (gap + radius) * normal, displacement)
    slides = is_box & (normal == 0.0)
    axes = jnp.eye(displacement.shape[-1], dtype=displacement.dtype)
    return moved, [slides[:, index, None] * axis for index, axis in enumerate(axes)]
