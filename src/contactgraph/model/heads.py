"""What rests until something that is driven carries it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.model.collision import Geometry
from contactgraph.model.contact_solver import ContactSolver
from contactgraph.model.hinge import hinge_constraint
from contactgraph.model.types import LocalInput, SpringMassDamper, Step, own_component

_PACE = 5.0
"""How much faster than a network's weights a weight is learned: it is a single number, newtons."""


class GroundSupport(eqx.Module):
    """Bodies with weight, on ground that bears them and rubs on them until they are carried.

    A body is carried as far as it is held, directly or through others, by one that is actuated.
    What is carried has its weight and no friction; what is not has friction and no weight. So a
    block on a table rests, and loads the arm that has lifted it. The weight is learned, in size
    and direction: no axis is known to be the vertical.
    """

    weight_root: Float[Array, "node_types D"]
    """Force on a carried node of each kind, N, in `_PACE`."""
    node_types: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, node_types: int, dimension: int):
        """`node_types`: how many kinds of node there are."""
        # A product, so that its type is not weak: else the first update of training recompiles.
        self.weight_root = 0.0 * jnp.ones((node_types, dimension))
        self.node_types = node_types
        self.dimension = dimension

    def weight(self, node_type: Float[Array, "N node_types"]) -> Float[Array, "N D"]:
        """The force on each node while it is carried, N."""
        return _PACE * node_type @ self.weight_root


def lifted_fraction(
    actuated: Float[Array, " N"],
    hold: Float[Array, " E"],
    geometry: Geometry,
    group_capacity: int | None = None,
) -> Float[Array, " N"]:
    """How far each node is carried, in [0, 1]: the best chain of holding edges to an actuated one.

    `actuated`: 1 or 0; `hold`: how far each edge holds, in [0, 1). `room`: no more nodes than so
    many hold each other; None: all may.
    """
    count = actuated.shape[0]
    share = actuated.astype(hold.dtype)
    if group_capacity is not None:
        ends = jnp.stack([geometry.first, geometry.second])
        for _ in range(group_capacity - 1):
            arriving = (hold * share[ends[::-1]]).reshape(-1)
            best = jax.ops.segment_max(arriving, ends.reshape(-1), count)
            share = jnp.maximum(share, best)
        return share
    first, second = geometry.ends(count)
    holds = first.T @ (hold[:, None] * second)
    holds = holds + holds.T
    for _ in range(count - 1):
        share = jnp.maximum(share, jnp.max(holds * share, axis=1))
    return share


_MOST_HELD = 1.0 - 1e-3
"""Of the coefficient of holding: a damper a thousand times stiffer than a mass of 1 in a step."""
_IMPACT_SPEED = 0.1
"""Change of velocity, m/s, from about which a step counts as an impact."""
_HEAD_PACE = 5.0
"""How much faster than a network's weights masses and gains are learned: each is a single number
on which everything rests."""
_SMALLEST = 1e-6


class CoupledHead(eqx.Module):
    r"""Parameters of every node from masses, and springs and dampers along the active edges.

    Every kind of node has a mass and a gain on the control, every node a damper to the ground;
    the networks give every active edge a coefficient of holding (0 free, 1 rigid) and a spring.
    Then `ContactSolver` is solved for the whole scene at once, so that what one body of a chain
    feels reaches all others, however long the chain. Seen from one node the solution is a
    spring-mass-damper: its inverse mass is that of the group it is in, its damper is stiff in the
    step of an impact, its spring is what keeps it on the circle about a hinge.
    """

    log_mass: Float[Array, " node_types"]
    """Of the mass in kg, up to a common factor that no motion tells; in `_HEAD_PACE`."""
    gain_root: Float[Array, " node_types"]
    """Root of the force on a node for each newton of control, in `_HEAD_PACE`; its square is
    never negative."""
    ground: eqx.nn.MLP
    edge: eqx.nn.MLP
    support: GroundSupport | None
    """What bears bodies that nobody carries; None: all float."""
    width: int = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    length: float = eqx.field(static=True)

    def __init__(
        self,
        width: int,
        node_types: int,
        *,
        length: float,
        support: GroundSupport | None = None,
        key: PRNGKeyArray,
    ):
        """`node_types`: how many kinds of node there are; `length` [m] scales rest lengths."""
        ground_key, edge_key = jax.random.split(key)
        # Products, so that their types are not weak: else the first update of training recompiles.
        self.log_mass = 0.0 * jnp.ones(node_types)
        self.gain_root = jnp.ones(node_types) / _HEAD_PACE
        self.ground = eqx.nn.MLP(node_types + 1, 1, width, 1, key=ground_key)
        self.edge = eqx.nn.MLP(width, 3, width, 1, key=edge_key)
        self.support = support
        self.width = width
        self.node_types = node_types
        self.length = length

    @property
    def free_response(self) -> np.ndarray:
        """[node_types] Acceleration of a free node for each newton of control, 1/kg."""
        gain_root, log_mass = np.asarray(self.gain_root), np.asarray(self.log_mass)
        return (_HEAD_PACE * gain_root) ** 2 * np.exp(-_HEAD_PACE * log_mass)

    def __call__(
        self,
        local: LocalInput,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        step: Step,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        theta, dt = step.theta, step.dt
        network, gain, hold = self._network(local, message, theta)
        weight = None
        if self.support is not None:
            share = lifted_fraction(local.actuated, hold, local.geometry, local.group_capacity)
            weight = share[:, None] * self.support.weight(local.node_type)
            network = dataclasses.replace(network, ground=(1.0 - share) * network.ground)
        motion = network.step(
            local.velocity,
            gain,
            local.geometry,
            dt,
            step.control_size,
            weight,
            local.group_capacity,
        )
        # A damper whose other end moves, such that the discrete step makes `change` of it.
        size = jnp.sqrt(jnp.sum(motion.change**2, axis=-1) + _SMALLEST**2)
        impact = (1.0 - motion.own_share) * size / (size + _IMPACT_SPEED)
        part = jnp.clip(motion.ground_share + impact, 0.0, 1.0)
        damping = (part / ((1.0 - theta * part) * dt))[:, None] * jnp.ones_like(motion.change)
        damper_end = local.velocity + motion.change / (part + _SMALLEST)[:, None]
        # What acts besides is slowed by that damper too; the network's solution already is.
        undamped = 1.0 + theta * dt * damping
        acceleration = motion.acceleration
        parameters = SpringMassDamper(
            response=motion.response * undamped[..., None],
            stiffness_rate=jnp.zeros_like(damping),
            damping_rate=damping,
            equilibrium=local.position,
            equilibrium_velocity=damper_end,
            impact_displacement=motion.impact_displacement,
            acceleration=None if acceleration is None else acceleration * undamped,
        )
        return parameters if local.anchor is None else _on_circles(parameters, local, hold, step)

    def _network(
        self, local: LocalInput, message: Float[Array, "active 2 E W"], theta: Float[Array, ""]
    ) -> tuple[ContactSolver, Float[Array, " N"], Float[Array, " E"]]:
        """The network, the gains on the control, and how far each edge holds, in [0, 1)."""
        ground = jax.vmap(self.ground)(local.node_features)[:, 0]
        # What holds two bodies does not depend on which of them is called the first.
        out = jax.vmap(jax.vmap(self.edge))(jnp.sum(message, axis=1))
        weight = local.weight.T

        def over_types(per_type: Float[Array, "active E"]) -> Float[Array, " E"]:
            return jnp.sum(weight * per_type, axis=0)

        hold = _MOST_HELD * over_types(jax.nn.sigmoid(out[..., 0] + 5.0))
        network = ContactSolver(
            mass=jnp.exp(_HEAD_PACE * local.node_type @ self.log_mass),
            ground=jax.nn.softplus(ground - 6.0),
            hold=hold / (1.0 - hold),
            spring=over_types(jax.nn.softplus(out[..., 1] - 6.0)),
            rest=over_types(jax.nn.softplus(out[..., 2])) * self.length,
            displacing_fraction=local.geometry.fraction_after_impact - theta,
        )
        return network, (_HEAD_PACE * local.node_type @ self.gain_root) ** 2, hold


def _on_circles(
    parameters: SpringMassDamper, local: LocalInput, hold: Float[Array, " E"], step: Step
) -> SpringMassDamper:
    """The parameters with the springs that keep hinged bodies turning about their hinges."""
    assert local.anchor is not None
    theta, dt = step.theta, step.dt
    damper = dt * parameters.damping_rate
    change = damper * (parameters.equilibrium_velocity - local.velocity) / (1.0 + theta * damper)
    geometry = local.geometry
    circles = hinge_constraint(
        local.anchor,
        local.position,
        local.velocity + change,
        hold,
        jnp.stack([geometry.first, geometry.second]),
        geometry.relative_velocity,
    )
    stiffness = circles.rate[:, None] * jnp.ones_like(damper)
    before, after = 1.0 + theta * damper, 1.0 + theta * damper + theta**2 * dt**2 * stiffness
    sprung = SpringMassDamper(
        response=parameters.response * (after / before)[..., None],
        stiffness_rate=stiffness,
        damping_rate=parameters.damping_rate,
        equilibrium=circles.centre,
        equilibrium_velocity=parameters.equilibrium_velocity,
        impact_displacement=parameters.impact_displacement,
        acceleration=None
        if parameters.acceleration is None
        else parameters.acceleration * (after / before),
    )
    pulled = damper * (sprung.equilibrium_velocity - local.velocity)
    pulled = pulled - dt * stiffness * (
        local.position + theta * dt * local.velocity - circles.centre
    )
    # Where the step would lead without a push; see `ThetaMethod`.
    position = (
        local.position + dt * (local.velocity + theta * pulled / after) + sprung.impact_displacement
    )
    return eqx.tree_at(
        lambda p: p.impact_displacement, sprung, sprung.impact_displacement + circles.kept(position)
    )


class PerDegreeHead(eqx.Module):
    """The paper's head: 1/m, k, c and equilibrium of every node and degree of freedom, freely.

    The equilibrium is relative to the node's hinge, or, where it has none, to its own position.
    Parameters are positive.
    """

    node: eqx.nn.MLP
    width: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, width: int, dimension: int, *, key: PRNGKeyArray):
        self.node = eqx.nn.MLP(width, 4 * dimension, width, 2, key=key)
        self.width = width
        self.dimension = dimension

    def __call__(
        self,
        local: LocalInput,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        step: Step,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        out = jax.vmap(self.node)(embedding).reshape(-1, 4, self.dimension)
        origin = local.position
        if local.anchor is not None:
            origin = jnp.where(jnp.isfinite(local.anchor), local.anchor, origin)
        return SpringMassDamper(
            response=own_component(5.0 * jax.nn.sigmoid(out[:, 0]), step.control_size),
            stiffness_rate=5.0 * jax.nn.sigmoid(out[:, 1]),
            damping_rate=5.0 * jax.nn.sigmoid(out[:, 2]),
            equilibrium=origin + out[:, 3],
            equilibrium_velocity=jnp.zeros_like(origin),
            impact_displacement=jnp.zeros_like(origin),
        )
