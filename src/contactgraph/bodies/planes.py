"""Planes, such as walls and tables, which every node may touch."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, along_normals
from contactgraph.bodies.polygons import most_points, plane_points
from contactgraph.bodies.rotations import levers, placed
from contactgraph.data.trajectory_batch import Nodes


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
    found = along_normals(
        edge_index=jnp.stack([node, node]),
        jacobian=jnp.stack([jacobian, jnp.zeros_like(jacobian)]),
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
