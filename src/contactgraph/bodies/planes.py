"""Planes, such as walls and tables, which every node may touch and on which hulls slide."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, Rows, along_normals
from contactgraph.bodies.graph import Bodies
from contactgraph.bodies.polygons import FAR, most_points, nearest_places, vertices_of
from contactgraph.bodies.rotations import levers, placed, rotation_matrix
from contactgraph.data.trajectory_batch import Nodes

_BOTH = 0.02
"""Part of the speed of a turn that is added to the speed of the body, and the reverse: where one of
them is 0, the limits for small ones tell the friction."""


def plane_geometry(
    bodies: Bodies,
    motion: Float[Array, "N G"],
    distance: Float[Array, " N"],
    turn_length: float | None = None,
    length: float = 1.0,
) -> Geometry:
    """The geometry of every node with every plane in a step.

    A node, which would move by ``motion`` [m] if no contact hindered it, touches a plane at
    ``distance`` [m]. The second node of such an edge is the first again, with a contact Jacobian of
    0; that of the first is 0, too, unless the two meet in the step. With a ``turn_length`` [m]
    bodies have outlines, and each has `plane_points`: see `polygon_meeting`.
    """
    position, nodes, planes = bodies.position, bodies.nodes, jnp.asarray(bodies.nodes.planes)
    dimension = planes.shape[1] - 1
    # Rows are those of the first node first, then of its first plane.
    if turn_length is None:
        height = jnp.sum(planes[:, :-1] * position[:, None], axis=-1) - planes[:, -1]
        height, node = height[..., None], jnp.repeat(jnp.arange(len(position)), len(planes))
        jacobian = jnp.broadcast_to(jnp.eye(dimension), (len(node), dimension, dimension))
    else:
        outlines = placed(jnp.asarray(nodes.outlines), position, turn_length)
        height, lowest = plane_points(outlines, planes, length)
        node = jnp.repeat(jnp.arange(len(position)), height[0].size)
        places = lowest.reshape(-1, dimension)
        jacobian = levers(places, position, bodies.turns, node, turn_length)
    normal = jnp.broadcast_to(-planes[:, None, :-1], (*height.shape, dimension))
    height, normal = height.reshape(-1), normal.reshape(-1, dimension)
    jacobian = jacobian * nodes.mobile[node][:, None, None]
    found = along_normals(
        Rows(jnp.stack([node, node]), jnp.stack([jacobian, jnp.zeros_like(jacobian)])),
        normal=normal,
        distance=height,
        contact_distance=distance[node],
        velocity=bodies.velocity,
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
    bodies: Bodies,
    distance: Float[Array, " N"],
    turn_length: float | None,
    length: float,
    dt: float,
) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step of ``dt`` [s] in which weight alone acts on them,
    else 0. Other arguments: see `plane_geometry`."""
    falls = dt * bodies.nodes.passive[:, None] * bodies.nodes.gravity
    motion = dt * bodies.velocity.at[:, : falls.shape[1]].add(falls)
    return on_planes(plane_geometry(bodies, motion, distance, turn_length, length), bodies.nodes)


def weighed_down(geometry: Geometry, nodes: Nodes, dt: float) -> Float[Array, " C"] | float:
    """m; how far passive bodies may part in a step of ``dt`` [s] and meet again within it, if their
    weight brings them together and a plane bears one: a stack at rest does not approach."""
    if nodes.gravity is None or nodes.planes is None:
        return 0.0
    both = jnp.all(nodes.passive[geometry.edge_index], axis=0)
    return both * 0.5 * dt**2 * jnp.abs(geometry.normal @ nodes.gravity)


Sliding = Callable[[Float[Array, "N G"]], tuple[Float[Array, "N 1"], Float[Array, "N G"]]]
"""From velocities [N, G] m/s to each body's sliding speed [N, 1] m/s, and to the weights [N, G]
with which the squares of its velocities sum up to the square of that speed."""


def hull_sliding(bodies: Bodies, turn_length: float, slow: float) -> Sliding:
    """Of hulls, each vertex of which bears an equal part of the weight, with Coulomb's friction.

    The power of friction is that of a norm of the velocity, the mean speed of the vertices, whose
    gradient is the force and the torque (Goyal, Ruina and Papadopoulos 1991). ``slow`` [m/s] is a
    speed at which bodies rest.
    """
    nodes, position = bodies.nodes, jax.lax.stop_gradient(bodies.position)
    turn = rotation_matrix(position[:, 3:] / turn_length)
    gravity = jnp.asarray(nodes.gravity)
    upward = -gravity / jnp.sqrt(jnp.sum(gravity**2))
    corners = vertices_of(jnp.asarray(nodes.outlines)).reshape(len(position), -1, 3)
    arm = jnp.einsum("nij,nvj->nvi", turn, corners) / turn_length
    # Level velocity of each vertex for a unit of turning about the direction against gravity, and
    # that direction in the axes of the body.
    lever, axis = jnp.cross(upward, arm), jnp.einsum("nij,i->nj", turn, upward)
    alike = jnp.all(corners[:, :, None] == corners[:, None], axis=-1)  # several tell one vertex
    weight = 1.0 / jnp.sum(alike, axis=2, keepdims=True)
    weight = (weight / jnp.sum(weight, axis=1, keepdims=True)).astype(arm.dtype)

    def sliding(velocity: Float[Array, "N G"]) -> tuple[Float[Array, "N 1"], Float[Array, "N G"]]:
        level = velocity[:, :3] - (velocity[:, :3] @ upward)[:, None] * upward
        spin = jnp.sum(velocity[:, 3:] * axis, axis=1, keepdims=True)
        reach = jnp.sum(weight * _length_of(lever), axis=1)
        across = jnp.cross(upward, jnp.eye(3)[jnp.argmin(jnp.abs(upward))])
        level_speed = _length_of(level)
        level += _BOTH * (jnp.abs(spin) * reach + slow) * across
        spin += jnp.where(spin < 0.0, -_BOTH, _BOTH) * (level_speed + slow) / (reach + 1e-9)
        moving = level[:, None] + spin[..., None] * lever
        speed = _length_of(moving)
        force = weight * moving / speed
        forward = jnp.sum(jnp.sum(force, axis=1) * level, axis=1, keepdims=True)
        turning = jnp.sum(force * lever, axis=(1, 2))[:, None]
        along = jnp.tile(forward / jnp.sum(level**2, axis=1, keepdims=True), 3)
        parts = jnp.concatenate([along, turning / spin * axis**2], axis=1)
        whole = jnp.sum(weight * speed, axis=1)
        return whole, whole * jnp.maximum(parts, 0.0)

    return sliding


def _length_of(vector: Float[Array, "*C D"]) -> Float[Array, "*C 1"]:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + 1e-18)
