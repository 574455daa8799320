"""Planes, such as walls and tables, which every node may touch."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.data.trajectory_batch import Nodes
from contactgraph.model.collision import Geometry

_LEAST_APPROACH = 1e-9
"""m"""


def plane_geometry(
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    motion: Float[Array, "N D"],
    distance: Float[Array, " N"],
    nodes: Nodes,
) -> Geometry:
    """The geometry of every node with every plane in a step.

    A node at ``velocity`` [m/s], which would move by ``motion`` [m] if no contact hindered it,
    touches a plane at ``distance`` [m]. The second node of such an edge is the first again,
    with a contact Jacobian of 0; that of the first is 0, too, unless the two meet in the step.
    """
    assert nodes.planes is not None
    count, dimension = position.shape
    planes = jnp.tile(nodes.planes, (count, 1))  # [N P, D+1], those of the first node first
    node = jnp.repeat(jnp.arange(count), len(nodes.planes))
    normal = planes[:, :-1]
    height = jnp.sum(normal * position[node], axis=-1) - planes[:, -1]
    approach = -jnp.sum(normal * motion[node], axis=-1)
    gap = height - distance[node]
    time = jnp.clip(gap / jnp.maximum(approach, _LEAST_APPROACH), 0.0, 1.0)
    meets = (approach > 0.0) & (time < 1.0) & nodes.mobile[node] & jnp.any(normal != 0.0, axis=-1)
    jacobian = jnp.eye(dimension) * meets[:, None, None]
    return Geometry(
        edge_index=jnp.stack([node, node]),
        displacement=-height[:, None] * normal,
        relative_velocity=-velocity[node] * meets[:, None],
        distance=height,
        predicted_distance=height - approach,
        closest_approach=height - jnp.maximum(approach, 0.0),
        direction=-normal,
        normal=-normal,
        impact_normal=-normal,
        approach=approach,
        time_of_impact=jnp.where(meets, time, 0.0),
        fraction_after_impact=(1.0 - time) * meets,
        contact_jacobian=jnp.stack([jacobian, jnp.zeros_like(jacobian)]),
        contact_distance=distance[node],
    )


def on_planes(geometry: Geometry, nodes: Nodes) -> Float[Array, " N"]:
    """1 for nodes that meet some plane in a step, else 0, where planes are the last contacts."""
    assert nodes.planes is not None
    count = len(nodes.mask)
    meets = geometry.contact_jacobian[0, -count * len(nodes.planes) :, 0, 0]
    return jnp.max(meets.reshape(count, -1), axis=1)
