"""Bodies of one step, before and after contacts act on them, and friction of the ground."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Geometry, Rows, incidence
from contactgraph.bodies.mass_matrix import GroupCapacity
from contactgraph.bodies.planes import Sliding

SLOW = 1e-4
"""See `FreeBodies.slow`, in units of speed."""
_LEAST = 1e-6
"""By which is divided."""


class FreeBodies(eqx.Module):
    """The bodies of one step before contacts act on them."""

    mass: Float[Array, "N G"]
    """kg, with what a servo adds; of a turn the inertia, over the squared length of its unit."""
    velocity: Float[Array, "N G"]
    """m/s"""
    ground_damper: Float[Array, " N"]
    """Times dt, in units of the mass."""
    deceleration: Float[Array, " N"]
    """By the ground, m/s^2, until a body rests."""
    weight: Float[Array, "N G 1"]
    """N, times dt."""
    driving: Float[Array, "N G W"]
    """kg: momentum for each m/s that the free actuated nodes get."""
    push: Float[Array, "N G 1"]
    """kg m/s: momentum that control and weight give in the step, as far as they are known."""
    speed: float = eqx.field(static=True, default=1.0)
    """Unit of speeds, m/s."""
    pushed: bool = eqx.field(static=True, default=False)
    """Whether friction counts that the ground slows bodies that are pushed along it."""
    lifted: Float[Array, " N"] | float = 0.0
    """Share of its weight that a hand bears."""
    sliding: Sliding | None = None
    """None: each body slides as an ellipsoid of its inertia."""

    @property
    def borne(self) -> Float[Array, "N G 1"]:
        """N; the weight that no other contact has to bear, and that makes nothing fall."""
        return jnp.reshape(self.lifted, (-1, 1, 1)) * self.weight

    @property
    def slow(self) -> float:
        """Speed of bodies that friction stops within a step, m/s."""
        return SLOW * self.speed


class ContactMotion(eqx.Module):
    """Effect of one step on every node, of the whole scene solved together."""

    velocity_change: Float[Array, "N G"]
    """By contacts, springs and the ground, without control and weight; m/s."""
    impact_displacement: Float[Array, "N G"]
    """m; by how much impacts displace more than the change of velocity alone would."""
    acceleration: Float[Array, "N G"]
    """By weight, m/s^2."""
    response: Float[Array, "N G W"]
    """Share of the acceleration of each free actuated node and axis."""
    own_share: Float[Array, "N G"]
    """Share of its own momentum that a node keeps, in (0, 1]."""
    ground_share: Float[Array, "N G"]
    """Share of its velocity that a node loses to the ground, in [0, 1)."""


def lifted_fraction(
    actuated: Float[Array, " N"],
    coupling: Float[Array, " E"],
    edges: Rows,
    group_capacity: GroupCapacity | None = None,
) -> Float[Array, " N"]:
    """Lifted fraction of each node, in [0, 1]: the strongest chain of edges to an actuated node.

    `actuated` is 1 or 0, the `coupling` of an edge in [0, 1), a chain as strong as the product of
    its edges. `group_capacity`: most nodes that are coupled; None: no limit.
    """
    count, edge_index = actuated.shape[0], edges.edge_index
    share = actuated.astype(coupling.dtype)
    if group_capacity is not None:
        for _ in range(group_capacity.nodes - 1):
            arriving = (coupling * share[edge_index[::-1]]).reshape(-1)
            best = jax.ops.segment_max(arriving, edge_index.reshape(-1), count)
            share = jnp.maximum(share, best)
        return share
    first, second = incidence(edge_index, count).astype(coupling.dtype)
    couplings = first.T @ (coupling[:, None] * second)
    couplings = couplings + couplings.T
    for _ in range(count - 1):
        share = jnp.maximum(share, jnp.max(couplings * share, axis=1))
    return share


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
    least = _LEAST * bodies.speed * bodies.mass[:, :1]
    lost = (_sliding(bodies, before)[0] - slower) / jnp.maximum(taken, least)
    return jnp.clip(lost, 0.0, jnp.max(square / bodies.mass, axis=1, keepdims=True))


def sliding_share(
    bodies: FreeBodies, geometry: Geometry, coupling: Float[Array, " C"], dt: float
) -> Float[Array, " N"]:
    """Share of a step in which the ground slows a body: not while it rests until it is struck."""
    struck = jnp.zeros_like(bodies.deceleration)
    struck = struck.at[geometry.edge_index].max(coupling * geometry.time_of_impact)
    taken = dt * jnp.maximum(bodies.deceleration, bodies.slow)
    return jax.lax.stop_gradient(
        1.0 - jax.nn.relu(struck - speed_of(bodies.velocity, bodies.speed) / taken)
    )


def speed_of(velocity: Float[Array, "n D"], unit: float) -> Float[Array, " n"]:
    """The Euclidean length, m/s, with a gradient everywhere; ``unit`` of speeds, m/s."""
    return jnp.sqrt(jnp.sum(velocity**2, axis=-1) + (_LEAST * unit) ** 2)


def _sliding(
    bodies: FreeBodies, change: Float[Array, "N G"]
) -> tuple[Float[Array, "N 1"], Float[Array, "N G"]]:
    """The speed [m/s] with which each body slides after a change of velocity, and its square's
    part for the square of the velocity along each coordinate.

    In the plane it is an ellipsoid's (Howe and Cutkosky 1996): a turn counts with the speed of the
    radius of gyration.
    """
    velocity = bodies.velocity + change
    if bodies.sliding is None:
        square = bodies.mass / bodies.mass[:, :1]
        return speed_of(jnp.sqrt(square) * velocity, bodies.speed)[:, None], square
    return bodies.sliding(velocity)
