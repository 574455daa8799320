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
    yielding: Float[Array, "N G"] | Float[Array, "N 1"],
    sliding: Float[Array, " N"],
    dt: float,
) -> Float[Array, "N G"]:
    """Dampers to the ground, times dt [kg], that take the impulse of its friction and not more.

    A damper c slows a body of effective mass m from v to v m / (m + c), so that it takes the
    impulse p if c = p / (v - p / m). ``change`` m/s is that of the velocity without the ground,
    ``yielding`` is 1 / m, and ``sliding`` the share of the step in which a body slides. A body that
    turns counts with the speed of its radius of gyration, as an ellipsoid of forces has it (Howe
    and Cutkosky 1996).
    """
    speed, yielding = jax.lax.stop_gradient((_speed(bodies, change), yielding))
    bound = bodies.mass * (bodies.deceleration * dt * sliding)[:, None]
    ground = bound / jnp.maximum(speed - bound * yielding, bodies.slow)
    return ground + bodies.ground_damper[:, None] * bodies.mass


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
    mass, slower = bodies.mass[:, :1], _speed(bodies, after)
    taken = ground[:, :1] * slower
    lost = (_speed(bodies, before) - slower) / jnp.maximum(taken, _LEAST * mass)
    return jnp.clip(lost, 0.0, 1.0 / mass)


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


def _speed(bodies: FreeBodies, change: Float[Array, "N G"]) -> Float[Array, "N 1"]:
    """m/s, after a change of velocity; of a turn, that of the radius of gyration."""
    by_axis = jnp.sqrt(bodies.mass / bodies.mass[:, :1]) * (bodies.velocity + change)
    return length_of(by_axis)[:, None]
