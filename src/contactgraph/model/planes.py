"""Planes, such as walls and tables, which every node may touch."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.data.trajectory_batch import Nodes
from contactgraph.model.collision import Geometry
from contactgraph.model.contacts import Contacts, damper_of
from contactgraph.model.polygons import most_points, plane_points
from contactgraph.model.rotations import levers, placed

_LEAST_APPROACH = 1e-9
"""m"""


def plane_geometry(
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    motion: Float[Array, "N G"],
    distance: Float[Array, " N"],
    nodes: Nodes,
    turns: Float[Array, " N"] | None = None,
    turn_length: float = 1.0,
    length: float = 1.0,
) -> Geometry:
    """The geometry of every node with every plane in a step.

    A node at ``velocity`` [m/s], which would move by ``motion`` [m] if no contact hindered it,
    touches a plane at ``distance`` [m]. The second node of such an edge is the first again,
    with a contact Jacobian of 0; that of the first is 0, too, unless the two meet in the step.
    With ``turns`` bodies have outlines, and each has `plane_points`: see `polygon_meeting`.
    """
    assert nodes.planes is not None
    planes, dimension = nodes.planes, nodes.planes.shape[1] - 1
    points = 1 if turns is None else most_points(dimension)
    # Rows are those of the first node first, then of its first plane.
    node = jnp.repeat(jnp.arange(len(position)), len(planes) * points)
    rows = jnp.repeat(jnp.tile(planes, (len(position), 1)), points, axis=0)
    normal = rows[:, :-1]
    if turns is None:
        height = jnp.sum(normal * position[node], axis=-1) - rows[:, -1]
        jacobian = jnp.broadcast_to(jnp.eye(dimension), (len(node), dimension, dimension))
    else:
        assert nodes.outlines is not None
        shapes = placed(nodes.outlines, position, turn_length)
        height, lowest = (
            leaf.reshape(len(node), *leaf.shape[3:])
            for leaf in plane_points(shapes, planes, length)
        )
        jacobian = levers(lowest, position, turns, node, turn_length)

    def moved(motion: Float[Array, "N G"]) -> Float[Array, "C D"]:
        return jnp.einsum("cdg,cg->cd", jacobian, motion[node])

    approach = -jnp.sum(normal * moved(motion), axis=-1)
    gap = height - distance[node]
    time = jnp.clip(gap / jnp.maximum(approach, _LEAST_APPROACH), 0.0, 1.0)
    meets = (approach > 0.0) & (time < 1.0) & nodes.mobile[node] & jnp.any(normal != 0.0, axis=-1)
    acting = jacobian * meets[:, None, None]
    return Geometry(
        edge_index=jnp.stack([node, node]),
        displacement=-height[:, None] * normal,
        relative_velocity=-moved(velocity) * meets[:, None],
        distance=height,
        closest_approach=height - jnp.maximum(approach, 0.0),
        direction=-normal,
        normal=-normal,
        impact_normal=-normal,
        approach=approach,
        time_of_impact=jnp.where(meets, time, 0.0),
        fraction_after_impact=(1.0 - time) * meets,
        contact_jacobian=jnp.stack([acting, jnp.zeros_like(acting)]),
        contact_distance=distance[node],
    )


def plane_contacts(
    geometry: Geometry,
    softness: float,
    laws: tuple[Float[Array, " C"], Float[Array, " C"]],
    displacing_fraction: Float[Array, " C"],
    averaged: bool,
) -> Contacts:
    """Touches of a `plane_geometry`, with the ``laws`` of bounce and friction.

    They act where a node approaches by more than about ``softness`` [m]; ``averaged``: see
    `ContactLaw`.
    """
    closing = meets_plane(geometry) * jax.nn.sigmoid(geometry.approach / softness)
    nothing = jnp.zeros_like(closing)
    return Contacts(
        geometry=geometry,
        damper=damper_of(closing),
        spring=nothing,
        rest_length=nothing,
        touching=nothing + 1.0,
        displacing_fraction=displacing_fraction,
        acting=1.0 - geometry.time_of_impact * averaged,
        bounce=closing * laws[0],
        friction=laws[1],
        until_impact=geometry.time_of_impact * (1.0 - averaged),
    )


def meets_plane(geometry: Geometry) -> Float[Array, " C"]:
    """1 for the rows of a `plane_geometry` whose node meets the plane in the step, else 0."""
    return geometry.contact_jacobian[0, :, 0, 0]


def on_planes(geometry: Geometry, nodes: Nodes) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step, else 0; ``geometry`` is of planes alone."""
    return jnp.max(meets_plane(geometry).reshape(len(nodes.mask), -1), axis=1)


def rests_on_planes(
    position: Float[Array, "N G"],
    velocity: Float[Array, "N G"],
    distance: Float[Array, " N"],
    nodes: Nodes,
    dt: float,
    *shape: Any,
) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step in which weight alone acts on them, else 0.

    Arguments as of `plane_geometry`, ``shape`` its last ones.
    """
    assert nodes.gravity is not None
    falls = dt * nodes.passive[:, None] * nodes.gravity
    fallen = velocity.at[:, : falls.shape[1]].add(falls)
    geometry = plane_geometry(position, velocity, dt * fallen, distance, nodes, *shape)
    return on_planes(geometry, nodes)


def weighed_down(geometry: Geometry, nodes: Nodes, dt: float) -> Float[Array, " C"] | float:
    """m; how far passive bodies may part in a step of ``dt`` [s] and meet again within it, if their
    weight brings them together and a plane bears one: a stack at rest does not approach."""
    if nodes.gravity is None or nodes.planes is None:
        return 0.0
    both = jnp.all(nodes.passive[geometry.edge_index], axis=0)
    return both * 0.5 * dt**2 * jnp.abs(geometry.normal @ nodes.gravity)
