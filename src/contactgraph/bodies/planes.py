"""Planes, such as walls and tables, which every node may touch and on which hulls slide."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, along_normals
from contactgraph.bodies.polygons import FAR, most_points, nearest_places, vertices_of
from contactgraph.bodies.rotations import levers, placed, rotation_matrix
from contactgraph.bodies.shapes import Meeting
from contactgraph.data.trajectory_batch import Nodes

_BOTH = 0.02
"""Part of the speed of a turn that is added to the speed of the body, and the reverse: where one of
them is 0, the limits for small ones tell the friction."""


def plane_geometry(
    nodes: Nodes,
    *,
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    motion: Float[Array, "N G"],
    distance: Float[Array, " N"],
    turns: Float[Array, " N"] | None = None,
    turn_length: float | None = None,
    length: float = 1.0,
) -> Geometry:
    """The geometry of every node with every plane in a step.

    A node at ``position`` [m] and ``velocity`` [m/s], which would move by ``motion`` [m] if no
    contact hindered it, touches a plane at ``distance`` [m]. The second node of such an edge is the
    first again, with a contact Jacobian of 0; that of the first is 0, too, unless the two meet in
    the step. With a ``turn_length`` [m] bodies have outlines, and each has `plane_points`: see
    `polygon_meeting`.
    """
    assert nodes.planes is not None
    planes, dimension = nodes.planes, nodes.planes.shape[1] - 1
    points = 1 if turn_length is None else most_points(dimension)
    # Rows are those of the first node first, then of its first plane.
    node = jnp.repeat(jnp.arange(len(position)), len(planes) * points)
    rows = jnp.repeat(jnp.tile(planes, (len(position), 1)), points, axis=0)
    if turn_length is None:
        height = jnp.sum(rows[:, :-1] * position[node], axis=-1) - rows[:, -1]
        jacobian = jnp.broadcast_to(jnp.eye(dimension), (len(node), dimension, dimension))
    else:
        assert nodes.outlines is not None and turns is not None
        shapes = placed(nodes.outlines, position, turn_length)
        height, lowest = (
            leaf.reshape(len(node), *leaf.shape[3:])
            for leaf in plane_points(shapes, planes, length)
        )
        jacobian = levers(lowest, position, turns, node, turn_length)
    jacobian = jacobian * nodes.mobile[node][:, None, None]
    meeting = Meeting(
        displacement=-height[:, None] * rows[:, :-1],
        contact_jacobian=jnp.stack([jacobian, jnp.zeros_like(jacobian)]),
        sliding=[],
        edge_index=jnp.stack([node, node]),
    )
    found = along_normals(
        meeting,
        normal=-rows[:, :-1],
        distance=height,
        contact_distance=distance[node],
        velocity=velocity,
        motion=motion,
    )
    meets = meets_plane(found)
    return dataclasses.replace(
        found,
        relative_velocity=found.relative_velocity * meets[:, None],
        contact_jacobian=found.contact_jacobian * meets[:, None, None],
    )


def plane_points(
    outlines: Float[Array, "N P V ..."], planes: Float[Array, "P D+1"], length: float
) -> tuple[Float[Array, "N P points"], Float[Array, "N P points D"]]:
    """The `most_points` lowest vertices of every body above every plane: heights and places, m.

    ``planes``: see `Nodes.planes`.
    """
    dimension = outlines.shape[-1]
    vertices = vertices_of(outlines).reshape(len(outlines), 1, -1, dimension)
    vertices = jnp.repeat(vertices, len(planes), axis=1)
    normal, offset = planes[:, None, :-1], planes[:, -1:]
    height = jnp.sum(vertices * normal, axis=-1) - offset
    flat = jax.lax.stop_gradient(height).reshape(-1, height.shape[2])
    places, count = vertices.reshape(*flat.shape, dimension), most_points(dimension)
    chosen, exists = (
        leaf.reshape(*height.shape[:2], count)
        for leaf in nearest_places(flat, jnp.ones_like(places), places, length, count)
    )
    lowest = jnp.take_along_axis(vertices, chosen[..., None], axis=2)
    height = jnp.take_along_axis(height, chosen, axis=2)
    return jnp.where(exists, height, FAR * length), lowest


def meets_plane(geometry: Geometry) -> Float[Array, " C"]:
    """1 for the rows of a `plane_geometry` whose node meets the plane in the step, else 0."""
    return (geometry.fraction_after_impact > 0.0).astype(geometry.distance.dtype)


def on_planes(geometry: Geometry, nodes: Nodes) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step, else 0; ``geometry`` is of planes alone."""
    return jnp.max(meets_plane(geometry).reshape(len(nodes.mask), -1), axis=1)


def rests_on_planes(
    nodes: Nodes,
    *,
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    distance: Float[Array, " N"],
    turns: Float[Array, " N"],
    turn_length: float | None,
    length: float,
    dt: float,
) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step of ``dt`` [s] in which weight alone acts on them,
    else 0. Other arguments: see `plane_geometry`."""
    assert nodes.gravity is not None
    falls = dt * nodes.passive[:, None] * nodes.gravity
    found = plane_geometry(
        nodes,
        position=position,
        velocity=velocity,
        motion=dt * velocity.at[:, : falls.shape[1]].add(falls),
        distance=distance,
        turns=turns,
        turn_length=turn_length,
        length=length,
    )
    return on_planes(found, nodes)


def weighed_down(geometry: Geometry, nodes: Nodes, dt: float) -> Float[Array, " C"] | float:
    """m; how far passive bodies may part in a step of ``dt`` [s] and meet again within it, if their
    weight brings them together and a plane bears one: a stack at rest does not approach."""
    if nodes.gravity is None or nodes.planes is None:
        return 0.0
    both = jnp.all(nodes.passive[geometry.edge_index], axis=0)
    return both * 0.5 * dt**2 * jnp.abs(geometry.normal @ nodes.gravity)


class Patch(eqx.Module):
    """The vertices of hulls, each with an equal part of the weight and Coulomb's friction.

    The power of friction is that of a norm of the velocity, the mean speed of the vertices, whose
    gradient is the force and the torque (Goyal, Ruina and Papadopoulos 1991).
    """

    lever: Float[Array, "N V D"]
    """Level velocity of each vertex for a unit of turning about the direction against gravity."""
    weight: Float[Array, "N V 1"]
    """Part of the body's weight on each row, of which several may tell one vertex."""
    axis: Float[Array, "N 3"]
    """That direction in the axes of the body."""
    upward: Float[Array, " D"]

    @classmethod
    def of(
        cls,
        outlines: Float[Array, "N P V 5 3"] | None,
        gravity: Float[Array, " D"] | None,
        position: Float[Array, "N G"],
        turn_length: float | None,
    ) -> "Patch | None":
        """At these positions. None: bodies do not turn in space, or have no weight."""
        if outlines is None or gravity is None or turn_length is None or position.shape[1] != 6:
            return None
        position = jax.lax.stop_gradient(position)
        turn = rotation_matrix(position[:, 3:] / turn_length)
        upward = -gravity / jnp.sqrt(jnp.sum(gravity**2))
        corners = vertices_of(outlines).reshape(len(position), -1, 3)
        arm = jnp.einsum("nij,nvj->nvi", turn, corners) / turn_length
        alike = jnp.all(corners[:, :, None] == corners[:, None], axis=-1)
        share = 1.0 / jnp.sum(alike, axis=2, keepdims=True)
        share = share / jnp.sum(share, axis=1, keepdims=True)
        axis = jnp.einsum("nij,i->nj", turn, upward)
        return cls(jnp.cross(upward, arm), share.astype(arm.dtype), axis, upward)

    def sliding(
        self, velocity: Float[Array, "N G"], slow: float
    ) -> tuple[Float[Array, "N 1"], Float[Array, "N G"]]:
        """The mean speed of the vertices, m/s, and what makes up its square: the part for the
        square of the velocity along each coordinate, which is the force over that velocity, times
        the speed. ``slow`` [m/s] is a speed at which bodies rest."""
        level = velocity[:, :3] - (velocity[:, :3] @ self.upward)[:, None] * self.upward
        spin = jnp.sum(velocity[:, 3:] * self.axis, axis=1, keepdims=True)
        reach = jnp.sum(self.weight * _length_of(self.lever), axis=1)
        across = jnp.cross(self.upward, jnp.eye(3)[jnp.argmin(jnp.abs(self.upward))])
        level_speed = _length_of(level)
        level += _BOTH * (jnp.abs(spin) * reach + slow) * across
        spin += jnp.where(spin < 0.0, -_BOTH, _BOTH) * (level_speed + slow) / (reach + 1e-9)
        moving = level[:, None] + spin[..., None] * self.lever
        speed = _length_of(moving)
        force = self.weight * moving / speed
        forward = jnp.sum(jnp.sum(force, axis=1) * level, axis=1, keepdims=True)
        turning = jnp.sum(force * self.lever, axis=(1, 2))[:, None]
        along = jnp.tile(forward / jnp.sum(level**2, axis=1, keepdims=True), 3)
        parts = jnp.concatenate([along, turning / spin * self.axis**2], axis=1)
        whole = jnp.sum(self.weight * speed, axis=1)
        return whole, whole * jnp.maximum(parts, 0.0)


def _length_of(vector: Float[Array, "*C D"]) -> Float[Array, "*C 1"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + 1e-18)
