"""The law of contact: types of bodies, servos, contacts with a direction, bounce and friction."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry, as_near
from contactgraph.bodies.pins import with_pins_held
from contactgraph.bodies.planes import (
    Patch,
    on_planes,
    plane_geometry,
    rests_on_planes,
    weighed_down,
)
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.model.actuation import Actuation, actuated_slots
from contactgraph.model.constraints import plane_contacts, with_pins
from contactgraph.model.contacts import MAX_COUPLING, Contacts, damper_of
from contactgraph.model.free_bodies import FreeBodies, lifted_fraction
from contactgraph.model.heads import coupling_starts, with_hinge_springs
from contactgraph.model.types import LocalInput, SpringMassDamper, Step

PACE = 5.0
"""Scale of each type's numbers in their parameters, which learn faster than weights by this."""
DECELERATION = 10.0
"""Unit of decelerations by the ground, in units of speed a second."""
_SOFTEST = 0.5
"""Most that touches and the first type that holds lack of rigid; else types look alike."""
_LEAST_FRICTION = 1e-3
_PLANE_LEARNED = 0.1
"""Learned part of the distance from planes, as a share of what the data tell."""
_EARLY, _ONE_SIDED = 0.01, 2e-4
"""Approaches in a step, in units of `length`: before a touch, and from which one acts."""
_NEAREST = 0.02
"""In units of `length`: points that are farther than the nearest by more do not touch."""
_SMALL = 1e-6
_SERVO_MASS = 100.0
"""Start of the mass of what a servo moves: it pushes, and hardly gives way."""


class ContactLaw(eqx.Module):
    """Parameters of every node from types of bodies, their actuation, and the active edges.

    Each node type has a mass, a damper and a deceleration by the ground, and shares in bounce and
    friction of its touches; networks give every active edge a coupling (0 free, 1 rigid) and a
    spring. A *hold* couples bodies in all directions, a *touch* where they meet, with friction.
    """

    log_mass: Float[Array, " types"]
    """Of the mass in kg, in units of `PACE`; motion determines masses up to a common factor."""
    damper_raw: Float[Array, " types"]
    """Of the damper to the ground, 1/s: softplus(`PACE` x - 6)."""
    deceleration_raw: Float[Array, " types"]
    """Of the deceleration by the ground, in units of `DECELERATION`: softplus(`PACE` x - 6)."""
    bounce_raw: Float[Array, " types+1"]
    """A touch bounces with sigmoid(`PACE` (x_i + x_j) - 3). The last is that of planes."""
    friction_raw: Float[Array, " types+1"]
    """A touch has the coefficient of friction softplus(`PACE` (x_i + x_j) - 4)."""
    log_inertia: Float[Array, "types ..."] | None
    """Of squared radii of gyration by `turn_length`, in space about axes, over `PACE`; or none."""
    log_spread: Float[Array, " types"] | None
    """Of the spread of log masses in a type, in units of `PACE`, or none."""
    plane_distance: Float[Array, " types"]
    """m, of a node from a plane that it touches, by the data; a tenth of it is learned."""
    plane_raw: Float[Array, " types"]
    edge: eqx.nn.MLP
    actuation: Actuation
    width: int = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    slots: int = eqx.field(static=True)
    averaged: bool = eqx.field(static=True)
    length: float = eqx.field(static=True)
    varying_mass: bool = eqx.field(static=True)
    identified: bool = eqx.field(static=True)
    rough: bool = eqx.field(static=True)
    speed: float = eqx.field(static=True)
    turn_length: float | None = eqx.field(static=True)
    told: tuple[str, ...] = eqx.field(static=True)
    """Parameters that trajectories told directly, and that are not learned: gradients through
    impacts are noise, and lead away from them."""

    def __init__(
        self,
        width: int,
        node_types: int,
        *,
        length: float,
        actuation: Actuation,
        slots: int = 1,
        averaged: bool = False,
        speed: float = 1.0,
        turn_length: float | None = None,
        varying_mass: bool = False,
        identified: bool = False,
        rough: bool = False,
        friction: float = 1.0,
        told: tuple[str, ...] = (),
        key: PRNGKeyArray,
    ):
        """``slots``: most actuated nodes; ``length`` [m]: about the contact distance; ``speed``:
        unit of speeds, m/s; what follows them: see `ModelConfig`."""
        axes = () if actuation.dimension == 2 else (3,)
        # Products have no weak type, with which the first training update would recompile.
        with jax.ensure_compile_time_eval():
            self.damper_raw = self.deceleration_raw = 0.0 * jnp.ones(node_types)
            self.log_mass = self.damper_raw + actuation.by_servo * np.log(_SERVO_MASS) / PACE
            self.bounce_raw = 0.0 * jnp.ones(node_types + 1)
            start = 0.5 * (4.0 + np.log(np.expm1(max(friction, _LEAST_FRICTION)))) / PACE
            on_planes = start if identified else -start
            self.friction_raw = (start * jnp.ones(node_types + 1)).at[-1].set(on_planes)
            self.plane_raw, self.plane_distance = self.damper_raw, 0.5 * length + self.damper_raw
            still = 0.0 * jnp.ones((node_types, *axes))
            self.log_inertia = None if turn_length is None else still
            self.log_spread = self.damper_raw - np.log(2.0) / PACE if varying_mass else None
        self.edge, self.actuation = eqx.nn.MLP(width, 3, width, 1, key=key), actuation
        self.width, self.node_types, self.slots, self.length = width, node_types, slots, length
        self.averaged, self.speed, self.identified = averaged, speed, identified
        self.turn_length, self.varying_mass, self.told = turn_length, varying_mass, told
        self.rough = rough

    def slowing(self, node_type: Float[Array, "N types"]) -> tuple[Array, Array]:
        """Damper, 1/s, and deceleration, m/s^2, of every node by the ground."""
        damper = jax.nn.softplus(PACE * node_type @ self._learned("damper_raw") - 6.0)
        if not self.rough:
            return damper, 0.0 * damper
        slowed = jax.nn.softplus(PACE * node_type @ self._learned("deceleration_raw") - 6.0)
        return damper, DECELERATION * self.speed * slowed

    def mass(
        self, node_type: Float[Array, "N types"], log_ratio: Float[Array, " N"] | float
    ) -> Float[Array, " N"]:
        """kg, with the logarithm of that in units of the type's own; see `log_mass`."""
        log_mass = self.log_mass
        if self.log_spread is not None:  # learned by what the motion of each body tells
            log_mass = jax.lax.stop_gradient(log_mass)
        return jnp.exp(PACE * node_type @ log_mass + log_ratio)

    def mass_ratio(self, node_type: Float[Array, "N types"], size: int) -> Float[Array, "N G"]:
        """The mass of every coordinate, in units of that of the body."""
        ratio = jnp.ones((len(node_type), size))
        if self.log_inertia is None:
            return ratio
        inertia = jnp.exp(PACE * node_type @ self.log_inertia).reshape(len(node_type), -1)
        return ratio.at[:, size - inertia.shape[1] :].multiply(inertia)

    def laws(
        self,
        node_type: Float[Array, "N types"],
        one: Int[Array, " C"],
        other: Int[Array, " C"] | None = None,
    ) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
        """Bounce and coefficient of friction of touches of nodes with others, or with planes."""
        if not self.rough:
            return jnp.zeros(one.shape), jnp.zeros(one.shape)

        def both(raw: Float[Array, " types+1"]) -> Float[Array, " C"]:
            each = node_type @ raw[:-1]
            return PACE * (each[one] + (raw[-1] if other is None else each[other]))

        bounce = MAX_COUPLING * jax.nn.sigmoid(both(self._learned("bounce_raw")) - 3.0)
        return bounce, jax.nn.softplus(both(self._learned("friction_raw")) - 4.0)

    def _learned(self, name: str) -> Float[Array, " types"]:
        """The parameter, without a gradient where `told` has it."""
        raw = getattr(self, name)
        return jax.lax.stop_gradient(raw) if name in self.told else raw

    def coasting(
        self,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        node_type: Float[Array, "N types"],
        nodes: Nodes,
        turns: Float[Array, " N"],
        dt: float,
    ) -> Float[Array, "N G"]:
        """Velocity of every node after a step of ``dt`` [s] in which only the ground slows it; with
        weight as given, but in space, where outlines tell which bodies lie on a plane."""
        damper, slowing = self.slowing(node_type)
        if nodes.gravity is not None:
            if nodes.planes is None or velocity.shape[1] != 6:
                return velocity
            on_ground = rests_on_planes(
                nodes,
                position=position,
                velocity=velocity,
                distance=self._plane_distance(node_type),
                turns=turns,
                turn_length=self.turn_length,
                length=self.length,
                dt=dt,
            )
            damper, slowing = on_ground * damper, on_ground * slowing
        energy = jnp.sum(self.mass_ratio(node_type, velocity.shape[1]) * velocity**2, axis=-1)
        speed = jnp.sqrt(energy + (_SMALL * self.speed) ** 2)
        left = jax.nn.relu(1.0 - dt * slowing / speed) / (1.0 + dt * damper)
        return jax.lax.stop_gradient(left)[:, None] * velocity

    def __call__(
        self,
        local: LocalInput,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        step: Step,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        theta, dt, nodes, node_type = step.theta, step.dt, local.nodes, local.node_type
        velocity, (count, coordinates) = local.velocity, local.position.shape
        dimension = self.actuation.dimension
        motion = self.actuation(local.position, velocity, node_type, nodes, theta, dt)
        own = 0.0 if nodes.log_mass is None else nodes.log_mass
        mass = self.mass(node_type, own) * motion.inertia
        mass = mass[:, None] * self.mass_ratio(node_type, coordinates)
        slots = actuated_slots(nodes, self.slots)
        driving = jnp.einsum("nd,ns,de->ndse", mass, slots, jnp.eye(coordinates, dimension))
        # By the control in the step, as far as it is known, and until contacts hinder it.
        displaced, braked = jnp.zeros_like(velocity), local
        if local.control_displacement is not None:
            displaced = local.control_displacement / (theta * dt)
        if nodes.reach is not None:
            motion, displaced, braked = motion.stopped_at_reach(displaced, local, step)
        contacts, known = self._contacts(braked, message, step), theta * displaced
        contacts, pins = with_pins(contacts, braked, known, mass, self.turn_length, dt)
        lifted, capacity = local.actuated, local.group_capacity
        on_ground, falls = jnp.ones(count), jnp.zeros_like(velocity)
        if nodes.gravity is not None:
            holding = with_pins_held(contacts.holding[: len(local.weight)], pins, local.geometry)
            lifted = lifted_fraction(lifted, holding, local.geometry, capacity)
            # On a ground that is not described, bodies rest until an actuated one lifts them.
            falling = lifted * (1.0 - local.actuated) if nodes.planes is None else nodes.passive
            gravity = jnp.pad(nodes.gravity, (0, coordinates - dimension))
            on_ground, falls = 1.0 - lifted, falling[:, None] * gravity
        edges = len(contacts.damper)
        if nodes.planes is not None:
            # What is held goes with the hand, and falls on no plane.
            meeting = displaced + (1.0 - lifted[:, None]) * (dt * falls - displaced)
            planes = self._plane_contacts(braked, meeting, step)
            contacts = contacts.and_also(planes)
            on_ground = on_ground if nodes.gravity is None else on_planes(planes.geometry, nodes)
        damper, slowing = (on_ground * each for each in self.slowing(node_type))
        bodies = FreeBodies(
            mass=mass,
            velocity=braked.velocity,
            ground_damper=dt * damper,
            deceleration=slowing,
            weight=(mass * falls)[..., None],
            driving=driving.reshape(count, coordinates, -1),
            push=(mass * (nodes.actuated[:, None] * displaced + dt * falls))[..., None],
            speed=self.speed,
            pushed=not self.identified,
            patch=Patch.of(nodes.outlines, nodes.gravity, local.position, self.turn_length),
        )
        if self.identified:
            contacts = contacts.pushed_out(dt).pushing(bodies, dt, capacity)
        elif nodes.planes is not None:  # from which a hand may lift what it holds
            on_plane = jnp.arange(len(contacts.damper)) >= edges
            contacts = contacts.pushing(bodies, dt, capacity, on_plane)
        solution = contacts.solve(bodies, dt, capacity, self.rough)
        if nodes.reach is not None:
            solution = motion.kept_within_reach(solution, displaced, slots, local, braked, step)
        parameters = motion.parameters(local, slots, solution, step, self.speed, pins)
        if local.anchor is None:
            return parameters
        return with_hinge_springs(
            parameters,
            local,
            contacts.coupling[: len(local.weight)],
            step,
            solution.velocity_change,
        )

    def _contacts(
        self, local: LocalInput, message: Float[Array, "active 2 E W"], step: Step
    ) -> Contacts:
        """Contacts of the edges."""
        # The sum over directions does not depend on which node is the first.
        out = jax.vmap(jax.vmap(self.edge))(jnp.sum(message, axis=1))
        geometry, weight = local.contact_points, local.weight.T
        points = geometry.edge_index.shape[1] // max(1, weight.shape[1])
        if points > 1:
            out = jnp.tile(out, (1, points, 1))
            near = as_near(geometry, local.geometry, _NEAREST * self.length)
            weight = jnp.tile(weight, (1, points)) * near
        touch = jnp.zeros_like(weight[0])
        if len(weight) > 1:
            # A contact predicted too early: bodies do not meet, or their outlines are apart.
            early = geometry.approach > (tolerance := _EARLY * self.length)
            early |= self.identified & (geometry.distance - geometry.contact_distance > tolerance)
            weight = jnp.where(early & (geometry.fraction_after_impact == 0.0), 0.0, weight)
            nearer = geometry.approach + weighed_down(geometry, local.nodes, step.dt)
            closing = jax.nn.sigmoid(nearer / (_ONE_SIDED * self.length))
            weight = weight.at[0].multiply(closing)
            touch = weight[0]
        pushing = weight.at[:2].set(0.0)  # The residue of a spring would push bodies in touch.
        each = jax.nn.sigmoid(out[..., 0] + coupling_starts(len(weight))[:, None])
        each = each.at[:2].set(1.0 - (not self.identified) * _SOFTEST * (1.0 - each[:2]))
        coupling = jnp.sum(weight * each, axis=0)
        rest = jnp.sum(weight * jax.nn.softplus(out[..., 2]), axis=0) * self.length
        elastic, friction = self.laws(local.node_type, *geometry.edge_index)
        touching = touch / jnp.maximum(jnp.sum(weight, axis=0), _SMALL)
        bounce = touch * elastic
        # A contact that bounces is over in an instant.
        normal = geometry.normal + bounce[:, None] * (geometry.impact_normal - geometry.normal)
        square = jnp.sum(normal**2, axis=-1, keepdims=True)
        normal = normal / jnp.sqrt(
            jnp.maximum(square, _SMALL)
        )  # 0 of what fills up a list of edges
        return Contacts(
            geometry=dataclasses.replace(geometry, normal=normal),
            damper=damper_of(coupling),
            spring=jnp.sum(pushing * jax.nn.softplus(out[..., 1] - 6.0), axis=0),
            rest_length=rest,
            touching=touching,
            # Only a rigid bond begins by an impact; a soft one acts all through a step.
            displacing_fraction=self._displacing(geometry, step) * (1.0 - sum(weight[2:])),
            acting=1.0 - touching * geometry.time_of_impact * self.averaged,
            bounce=bounce,
            friction=friction,
            until_impact=step.theta * geometry.time_of_impact**2 * (1.0 - self.averaged),
        )

    def _plane_contacts(
        self, local: LocalInput, driven: Float[Array, "N D"], step: Step
    ) -> Contacts:
        """Touches of nodes with planes, which need no belief; ``driven`` m/s is what comes to the
        velocity if they do not touch."""
        motion = step.dt * (local.velocity + driven)
        distance = self._plane_distance(local.node_type)
        geometry = plane_geometry(
            local.nodes,
            position=local.position,
            velocity=local.velocity,
            motion=motion,
            distance=distance,
            turns=local.turns,
            turn_length=self.turn_length,
            length=self.length,
        )
        bounce, friction = self.laws(local.node_type, geometry.edge_index[0])
        return plane_contacts(
            geometry,
            softness=_ONE_SIDED * self.length,
            bounce=bounce,
            friction=friction,
            displacing_fraction=self._displacing(geometry, step),
            averaged=self.averaged,
        )

    def _plane_distance(self, node_type: Float[Array, "N types"]) -> Float[Array, " N"]:
        # Bodies that rest do not tell how much farther a plane might be.
        part = 1.0 + _PLANE_LEARNED * jnp.tanh(PACE * self.plane_raw)
        return node_type @ (jax.lax.stop_gradient(self.plane_distance) * part)

    def _displacing(self, geometry: Geometry, step: Step) -> Float[Array, " C"]:
        # Positions follow from velocities that are means.
        return (1.0 - self.averaged) * (geometry.fraction_after_impact - step.theta)
