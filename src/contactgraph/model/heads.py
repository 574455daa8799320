"""Heads: from messages on active edges to spring-mass-damper parameters of every node."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.model.collision import Geometry
from contactgraph.model.contact_solver import ContactSolution, ContactSolver, lifted_fraction
from contactgraph.model.shapes import hinge_constraint
from contactgraph.model.types import LocalInput, SpringMassDamper, Step, own_component

_PACE = 5.0
"""Scale of masses, gains and weights in their parameters. Each is a single number with a large
effect, and so learns faster than a network's weights by this factor."""
_MAX_COUPLING = 1.0 - 1e-3
"""Coupling of a damper that is a thousand times as stiff as a mass of 1 in a step."""
_IMPACT_SPEED = 0.1
"""Change of velocity, m/s, from about which a step counts as an impact."""
_MIN_SHARE = 1e-6
_EARLY = 0.01
"""Approach in a step, in units of `CoupledHead.length`, of bodies that are about to touch."""
_ONE_SIDED = 2e-4
"""Approach in a step, in units of `CoupledHead.length`, from which a touch acts."""


class GroundSupport(eqx.Module):
    """Weight of bodies, and ground that supports them with friction until they are lifted.

    A body is lifted as far as it is coupled, directly or through others, to an actuated one. A
    lifted body has weight and no friction, a supported body friction and no weight. So a block on
    a table rests, and loads the arm that has lifted it. The weight is learned in size and
    direction, because no axis is known to be vertical.
    """

    weight_root: Float[Array, "node_types D"]
    """Force on a lifted node of each type, N, in units of `_PACE`."""
    node_types: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, node_types: int, dimension: int):
        # A product has no weak type, with which the first training update would recompile.
        self.weight_root = 0.0 * jnp.ones((node_types, dimension))
        self.node_types = node_types
        self.dimension = dimension

    def weight(self, node_type: Float[Array, "N node_types"]) -> Float[Array, "N D"]:
        """The force on each node while it is lifted, N."""
        return _PACE * node_type @ self.weight_root


class CoupledHead(eqx.Module):
    r"""Parameters of every node from masses, and springs and dampers along the active edges.

    Every node type has a mass and a gain on the control, every node a damper to the ground; the
    networks give every active edge a coupling (0 free, 1 rigid) and a spring. `ContactSolver` then
    solves the whole scene at once, so that a force on one body of a chain reaches all others,
    however long the chain. The solution for one node is a spring-mass-damper: its inverse mass is
    that of its group, its damper is stiff in the step of an impact, its spring keeps it on the
    circle about a hinge.
    """

    log_mass: Float[Array, " node_types"]
    """Of the mass in kg, in units of `_PACE`; motion determines masses up to a common factor."""
    gain_root: Float[Array, " node_types"]
    """Root of the force on a node for each newton of control, in units of `_PACE`; its square is
    never negative."""
    ground: eqx.nn.MLP
    edge: eqx.nn.MLP
    support: GroundSupport | None
    """None: bodies have no weight."""
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
        """`node_types`: number of node types; `length` [m] is the unit of rest lengths."""
        ground_key, edge_key = jax.random.split(key)
        # Products have no weak type, with which the first training update would recompile.
        self.log_mass = 0.0 * jnp.ones(node_types)
        self.gain_root = jnp.ones(node_types) / _PACE
        self.ground = eqx.nn.MLP(node_types + 1, 1, width, 1, key=ground_key)
        self.edge = eqx.nn.MLP(width, 3, width, 1, key=edge_key)
        self.support = support
        self.width = width
        self.node_types = node_types
        self.length = length

    def with_gain(self, gain: float) -> "CoupledHead":
        """The same with this gain of actuated nodes, in newtons for each unit of control."""
        # Types of actuated nodes have odd numbers: see `InvariantFeatures.node_type`.
        gain_root = self.gain_root.at[1::2].set(gain**0.5 / _PACE)
        return eqx.tree_at(lambda head: head.gain_root, self, gain_root)

    @property
    def free_response(self) -> np.ndarray:
        """[node_types] Acceleration of a free node for each newton of control, 1/kg."""
        gain_root, log_mass = np.asarray(self.gain_root), np.asarray(self.log_mass)
        return (_PACE * gain_root) ** 2 * np.exp(-_PACE * log_mass)

    def __call__(
        self,
        local: LocalInput,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        step: Step,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        theta, dt = step.theta, step.dt
        solver, gain, coupling = self._solver(local, message, theta)
        capacity, weight = local.group_capacity, None
        touching, geometry = self._touching(local)
        holding = coupling if touching is None else (1.0 - touching) * coupling
        if self.support is not None:
            lifted = lifted_fraction(local.actuated, holding, local.geometry, capacity)
            weight = lifted[:, None] * self.support.weight(local.node_type)
            ground_damper = (1.0 - lifted) * solver.ground_damper
            solver = dataclasses.replace(solver, ground_damper=ground_damper)

        def solved(solver: ContactSolver) -> ContactSolution:
            return solver.solve(
                local.velocity, gain, geometry, dt, step.control_size, weight, capacity
            )

        solution, unhindered = solved(solver), None
        if touching is not None:
            holds = 1.0 - touching
            free = dataclasses.replace(
                solver, damper=holds * solver.damper, spring=holds * solver.spring
            )
            unhindered = solved(free).response
        # A damper whose other end moves, such that the discrete step makes the change of velocity.
        change = solution.velocity_change
        size = jnp.sqrt(jnp.sum(change**2, axis=-1) + _MIN_SHARE**2)
        impact = (1.0 - solution.own_share) * size / (size + _IMPACT_SPEED)
        part = jnp.clip(solution.ground_share + impact, 0.0, 1.0)
        damping = (part / ((1.0 - theta * part) * dt))[:, None] * jnp.ones_like(change)
        damper_end = local.velocity + change / (part + _MIN_SHARE)[:, None]
        # That damper slows the other forces too, but the solution already includes the slowing.
        undamped = 1.0 + theta * dt * damping
        acceleration = solution.acceleration
        parameters = SpringMassDamper(
            response=solution.response * undamped[..., None],
            stiffness_rate=jnp.zeros_like(damping),
            damping_rate=damping,
            equilibrium=local.position,
            equilibrium_velocity=damper_end,
            impact_displacement=solution.impact_displacement,
            acceleration=None if acceleration is None else acceleration * undamped,
            unhindered_response=unhindered,
        )
        if local.anchor is None:
            return parameters
        return with_hinge_springs(parameters, local, coupling, step)

    def _touching(self, local: LocalInput) -> tuple[Float[Array, " E"] | None, Geometry]:
        """Share of each active edge that only touches, and the geometry in which it slides."""
        if local.weight.shape[1] < 2:
            return None, local.geometry
        touching = local.weight[:, 0] / jnp.maximum(jnp.sum(local.weight, axis=1), _MIN_SHARE)
        return touching, local.geometry.along(1.0 - touching)

    def _solver(
        self, local: LocalInput, message: Float[Array, "active 2 E W"], theta: Float[Array, ""]
    ) -> tuple[ContactSolver, Float[Array, " N"], Float[Array, " E"]]:
        """The solver, the gains on the control, and the coupling of each edge, in [0, 1)."""
        ground = jax.vmap(self.ground)(local.node_features)[:, 0]
        # The sum over directions does not depend on which node is the first.
        out = jax.vmap(jax.vmap(self.edge))(jnp.sum(message, axis=1))
        weight = pushing = local.weight.T
        if len(weight) > 1:
            # Bodies that come nearer and do not meet in the step: a contact predicted too early.
            early = local.geometry.approach > _EARLY * self.length
            early = early & (local.geometry.fraction_after_impact == 0.0)
            weight = pushing = jnp.where(early, 0.0, weight)
            closing = jax.nn.sigmoid(local.geometry.approach / (_ONE_SIDED * self.length))
            weight = weight.at[0].multiply(closing)
            # Only a soft bond has a spring. The residue of one would push bodies that touch, and
            # pull at a rigid bond, which keeps the distance that it has.
            pushing = pushing.at[:2].set(0.0)

        def over_types(per_type: Float[Array, "active E"]) -> Float[Array, " E"]:
            return jnp.sum(weight * per_type, axis=0)

        start = coupling_starts(len(weight))
        coupling = _MAX_COUPLING * over_types(jax.nn.sigmoid(out[..., 0] + start[:, None]))
        solver = ContactSolver(
            mass=jnp.exp(_PACE * local.node_type @ self.log_mass),
            ground_damper=jax.nn.softplus(ground - 6.0),
            damper=coupling / (1.0 - coupling),
            spring=jnp.sum(pushing * jax.nn.softplus(out[..., 1] - 6.0), axis=0),
            rest_length=over_types(jax.nn.softplus(out[..., 2])) * self.length,
            # Only a rigid bond begins by an impact; a soft one acts all through a step.
            displacing_fraction=(local.geometry.fraction_after_impact - theta)
            * (1.0 - jnp.sum(weight[2:], axis=0)),
        )
        return solver, (_PACE * local.node_type @ self.gain_root) ** 2, coupling


def coupling_starts(active_types: int) -> np.ndarray:
    """[active] logits at which the couplings of the types start.

    A touch and the first type that holds start rigid, further ones apart from each other, spread
    over (0, 1): types that start alike share all data evenly, and stay alike.
    """
    further = np.arange(1, active_types - 1)
    return np.append(np.full(min(active_types, 2), 5.0), np.log((active_types - 1) / further - 1.0))


def with_hinge_springs(
    parameters: SpringMassDamper, local: LocalInput, coupling: Float[Array, " E"], step: Step
) -> SpringMassDamper:
    """The parameters with the springs that keep bodies turning about their hinges."""
    assert local.anchor is not None
    theta, dt = step.theta, step.dt
    damper = dt * parameters.damping_rate
    change = damper * (parameters.equilibrium_velocity - local.velocity) / (1.0 + theta * damper)
    constraint = hinge_constraint(
        local.anchor,
        local.position,
        local.velocity + change,
        coupling,
        local.geometry.edge_index,
        local.geometry.relative_velocity,
    )
    stiffness = constraint.stiffness_rate[:, None] * jnp.ones_like(damper)
    own = parameters.stiffness_rate
    before = 1.0 + theta * damper + theta**2 * dt**2 * own
    after = before + theta**2 * dt**2 * stiffness
    acceleration = parameters.acceleration
    sprung = dataclasses.replace(
        parameters,
        response=parameters.response * (after / before)[..., None],
        stiffness_rate=stiffness + own,
        equilibrium=(stiffness * constraint.center + own * parameters.equilibrium)
        / jnp.maximum(stiffness + own, _MIN_SHARE),
        acceleration=None if acceleration is None else acceleration * (after / before),
    )
    pull = damper * (sprung.equilibrium_velocity - local.velocity)
    pull = pull - dt * stiffness * (
        local.position + theta * dt * local.velocity - constraint.center
    )
    # The position after the step without control; see `ThetaMethod`.
    displacement = sprung.impact_displacement
    position = local.position + dt * (local.velocity + theta * pull / after) + displacement
    return dataclasses.replace(
        sprung, impact_displacement=displacement + constraint.projection(position)
    )


class PerDegreeHead(eqx.Module):
    """The paper's head: free 1/m, k, c and equilibrium of every node and degree of freedom.

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
