"""The springs of hinged bodies."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, sum_at_nodes
from contactgraph.bodies.graph import EncodedGraph
from contactgraph.bodies.shapes import HingedBodies
from contactgraph.dynamics.local_dynamics import SpringMassDamper

_MIN_WEIGHT = 1e-9
_MIN_SHARE = 1e-6
_RESTING_SPEED = 0.1
"""Relative speed, m/s, well below which two coupled bodies are at rest against each other."""


class HingeConstraint(eqx.Module):
    r"""Springs towards the hinges, and the projection of predicted positions onto circles.

    A spring of rate $\omega^2$ keeps a body turning about the spring's end. A hinged node has its
    own; a free node that is coupled to hinged ones has a share of theirs.
    """

    stiffness_rate: Float[Array, " N"]
    """k/m, 1/s^2."""
    center: Float[Array, "N D"]
    """m; the node's own position where it does not turn."""
    radius: Float[Array, " N"]
    """m; distance from the center that is to be kept."""
    strength: Float[Array, " N"]
    """Share in [0, 1] of the deviation from the circle that the projection removes."""

    def projection(self, position: Float[Array, "N D"]) -> Float[Array, "N D"]:
        """Displacement [m] of predicted positions onto their circles."""
        radius_vector = position - self.center
        length = jnp.sqrt(jnp.sum(radius_vector**2, axis=-1) + _MIN_WEIGHT)
        return (self.strength * (self.radius / length - 1.0))[:, None] * radius_vector


def hinge_constraint(
    anchor: Float[Array, "N D"],
    position: Float[Array, "N D"],
    velocity: Float[Array, "N D"],
    coupling: Float[Array, " E"],
    edges: Geometry,
) -> HingeConstraint:
    """The constraint of a step in which nodes move with `velocity` [m/s].

    `coupling` in [0, 1] is that of each edge; `anchor` [m] is NaN where a node has no hinge.
    """
    edge_index = edges.edge_index
    count = position.shape[0]
    bodies = HingedBodies(position, anchor)
    turning = jnp.sum(velocity**2, axis=-1) / bodies.radius_squared
    other = edge_index[::-1]
    # From the hinged end of an edge to its free end.
    passes = bodies.hinged[other] & ~bodies.hinged[edge_index]
    weight = jnp.where(passes, coupling, 0.0)
    square = jnp.sum(edges.relative_velocity**2, axis=-1)
    resting = weight * _RESTING_SPEED**2 / (square + _RESTING_SPEED**2)
    total = sum_at_nodes(weight, edge_index, count)
    share = jnp.minimum(1.0, 1.0 / jnp.maximum(total, _MIN_WEIGHT))
    rate = share * sum_at_nodes(weight * turning[other], edge_index, count)
    shared_center = sum_at_nodes(weight[..., None] * bodies.anchor[other], edge_index, count)
    shared_center = shared_center / jnp.maximum(total, _MIN_WEIGHT)[:, None]
    shared_center = jnp.where((total > _MIN_WEIGHT)[:, None], shared_center, position)
    center = jnp.where(bodies.hinged[:, None], bodies.anchor, shared_center)
    strength = share * sum_at_nodes(resting, edge_index, count)
    return HingeConstraint(
        stiffness_rate=jnp.where(bodies.hinged, turning, rate),
        center=center,
        radius=jnp.sqrt(jnp.sum((position - center) ** 2, axis=-1) + _MIN_WEIGHT),
        strength=jnp.where(bodies.hinged, 1.0, strength),
    )


def with_hinge_springs(
    parameters: SpringMassDamper,
    graph: EncodedGraph,
    coupling: Float[Array, " E"],
    change: Float[Array, "N D"],
    *,
    theta: Array,
    dt: float,
) -> SpringMassDamper:
    """The parameters with the springs that keep bodies turning about their hinges; ``change`` [m/s]
    is that of their velocities by contacts."""
    bodies = graph.bodies
    anchor = jnp.asarray(bodies.nodes.anchor)
    moving = bodies.velocity + change
    constraint = hinge_constraint(anchor, bodies.position, moving, coupling, graph.geometry)
    own = parameters.stiffness_rate
    before = 1.0 + theta * (dt * parameters.damping_rate) + theta**2 * dt**2 * own
    stiffness = constraint.stiffness_rate[:, None] * before  # as stiff whatever the damper does
    after = before + theta**2 * dt**2 * stiffness
    sprung = dataclasses.replace(
        parameters,
        response=parameters.response * (after / before)[..., None],
        stiffness_rate=stiffness + own,
        equilibrium=(stiffness * constraint.center + own * parameters.equilibrium)
        / jnp.maximum(stiffness + own, _MIN_SHARE),
        acceleration=(acceleration := parameters.acceleration * (after / before)),
    )
    moved = bodies.position + theta * dt * bodies.velocity
    pull = dt * (acceleration - stiffness * (moved - constraint.center))
    # The position after the step without control; see `ThetaMethod`.
    displacement = sprung.impact_displacement
    position = bodies.position + dt * (bodies.velocity + theta * pull / after) + displacement
    return dataclasses.replace(
        sprung, impact_displacement=displacement + constraint.projection(position)
    )
