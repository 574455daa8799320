"""Friction of a step between bodies and the ground on which they slide."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.collision import Geometry
from contactgraph.model.contact_solver import FreeBodies

_LEAST = 1e-6
"""By which is divided."""


def ground_dampers(
    bodies: FreeBodies,
    change: Float[Array, "N G"],
    yielding: Float[Array, "N 1"],
    sliding: Float[Array, " N"],
    dt: float,
) -> Float[Array, "N G"]:
    """Dampers to the ground, times dt [kg], that take the impulse of its friction and not more.

    A damper c slows a body of effective mass m from v to v m / (m + c), so that it takes the
    impulse p if c = p / (v - p / m). ``change`` m/s is that of the velocity without the ground,
    ``yielding`` is 1 / m, and ``sliding`` the share of the step in which a body slides.
    """
    speed, square, yielding = jax.lax.stop_gradient((*_sliding(bodies, change), yielding))
    bound = bodies.mass[:, :1] * (bodies.deceleration * dt * sliding)[:, None]
    ground = bound * square / jnp.maximum(speed - bound * yielding, bodies.slow)
    return ground + bodies.ground_damper[:, None] * bodies.mass


def yielding_alone(
    bodies: FreeBodies, change: Float[Array, "N G"], mobility: Float[Array, "N G"]
) -> Float[Array, "N 1"]:
    """Speed that a body would lose for each unit of momentum, 1/kg; ``mobility`` of its axes."""
    speed, square = _sliding(bodies, change)
    along = square * (bodies.velocity + change) / speed
    return jnp.sum(along**2 * mobility, axis=1, keepdims=True)


def yielding(
    bodies: FreeBodies,
    ground: Float[Array, "N G"],
    before: Float[Array, "N G"],
    after: Float[Array, "N G"],
) -> Float[Array, "N 1"]:
    """Speed that a body loses for each unit of momentum that these dampers take from it, 1/kg.

    Whatever pushes it makes up for a part, along the motion. ``before`` and ``after`` [m/s] are the
    changes of velocity without and with the dampers.
    """
    slower, square = _sliding(bodies, after)
    moving = bodies.velocity + after
    taken = jnp.sum(ground * moving**2, axis=1, keepdims=True) / slower
    lost = (_sliding(bodies, before)[0] - slower) / jnp.maximum(taken, _LEAST * bodies.mass[:, :1])
    return jnp.clip(lost, 0.0, jnp.max(square / bodies.mass, axis=1, keepdims=True))


def sliding_share(
    bodies: FreeBodies, geometry: Geometry, coupling: Float[Array, " C"], dt: float
) -> Float[Array, " N"]:
    """Share of a step in which the ground slows a body: not while it rests until it is struck."""
    struck = jnp.zeros_like(bodies.deceleration)
    struck = struck.at[geometry.edge_index].max(coupling * geometry.time_of_impact)
    taken = dt * jnp.maximum(bodies.deceleration, bodies.slow)
    return jax.lax.stop_gradient(1.0 - jax.nn.relu(struck - length_of(bodies.velocity) / taken))


def length_of(vector: Float[Array, "n D"]) -> Float[Array, " n"]:
    """The Euclidean length; with a gradient everywhere."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + _LEAST**2)


def _sliding(
    bodies: FreeBodies, change: Float[Array, "N G"]
) -> tuple[Float[Array, "N 1"], Float[Array, "N G"]]:
    """The speed [m/s] with which each body slides after a change of velocity, and its square's
    part for the square of the velocity along each coordinate.

    In the plane it is an ellipsoid's (Howe and Cutkosky 1996): a turn counts with the speed of the
    radius of gyration.
    """
    velocity = bodies.velocity + change
    if bodies.patch is None:
        square = bodies.mass / bodies.mass[:, :1]
        return length_of(jnp.sqrt(square) * velocity)[:, None], square
    return bodies.patch.sliding(velocity, bodies.slow)
