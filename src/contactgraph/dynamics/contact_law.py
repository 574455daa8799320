"""The law of contact: types of bodies, servos, contacts with a direction, bounce and friction."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry, as_near
from contactgraph.bodies.graph import Bodies, EncodedGraph
from contactgraph.bodies.pins import pin_geometry, pinned, with_pins_held
from contactgraph.bodies.planes import (
    Sliding,
    hull_sliding,
    meets_plane,
    on_planes,
    plane_geometry,
    weighed_down,
)
from contactgraph.dynamics.actuation import Actuation, actuated_slots
from contactgraph.dynamics.body_types import PACE, BodyTypes
from contactgraph.dynamics.contacts import MAX_COUPLING, Contacts, damper_of
from contactgraph.dynamics.free_bodies import SLOW, FreeBodies, lifted_fraction
from contactgraph.dynamics.hinges import with_hinge_springs
from contactgraph.dynamics.local_dynamics import SpringMassDamper

_SOFTEST = 0.5
"""Most that types which start rigid lack of it; else types look alike."""
_RIGID = 5.0
"""Logit at which the coupling of a rigid type starts."""
_LEAST_FRICTION = 1e-3
_EARLY, _ONE_SIDED = 0.01, 2e-4
"""Approaches in a step, in units of `length`: before a touch, and from which one acts."""
_NEAREST = 0.02
"""In units of `length`: points that are farther than the nearest by more do not touch."""
_SMALL = 1e-6
_SERVO_MASS = 100.0
"""Start of the mass of what a servo moves: it pushes, and hardly gives way."""


class ContactLaw(BodyTypes):
    """Parameters of every node from types of bodies, their actuation, and the active edges.

    Each node type has a mass, a damper and a deceleration by the ground, and shares in bounce and
    friction of its touches; networks give every active edge a coupling (0 free, 1 rigid) and a
    spring. A *hold* couples bodies in all directions, a *touch* where they meet, with friction.
    """

    bounce_raw: Float[Array, " types+1"]
    """A touch bounces with sigmoid(`PACE` (x_i + x_j) - 3). The last is that of planes."""
    friction_raw: Float[Array, " types+1"]
    """A touch has the coefficient of friction softplus(`PACE` (x_i + x_j) - 4)."""
    edge: eqx.nn.MLP
    width: int = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    slots: int = eqx.field(static=True)
    averaged: bool = eqx.field(static=True)
    varying_mass: bool = eqx.field(static=True)
    identified: bool = eqx.field(static=True)

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

    def __call__(
        self,
        graph: EncodedGraph,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        *,
        theta: Float[Array, ""],
        dt: float,
    ) -> SpringMassDamper:
        """Parameters of every node at one step of ``dt`` [s] with the implicitness ``theta``."""
        bodies, nodes = graph.bodies, graph.bodies.nodes
        count, coordinates = bodies.position.shape
        dimension, described = self.actuation.dimension, nodes.planes is not None
        motion = self.actuation(bodies, theta, dt)
        mass = self._coordinate_mass(bodies, motion)
        slots = actuated_slots(nodes, self.slots)
        driving = jnp.einsum("nd,ns,de->ndse", mass, slots, jnp.eye(coordinates, dimension))
        # By the control in the step, until contacts hinder it.
        displaced, braked = jnp.zeros_like(bodies.velocity), graph
        if graph.control_displacement is not None:
            displaced = graph.control_displacement / (theta * dt)
        if nodes.reach is not None:
            motion, displaced, braked = motion.stopped_at_reach(
                displaced, graph, theta=theta, dt=dt
            )
        contacts = self._contacts(braked, message, theta=theta, dt=dt)
        motion_until = dt * (braked.bodies.velocity + theta * displaced)
        pins = pin_geometry(braked.bodies, motion_until, self.turn_length)
        contacts = contacts.and_also(pin_contacts(pins))
        lifted, capacity = nodes.actuated.astype(mass.dtype), graph.group_capacity
        on_ground, falls = jnp.ones(count), jnp.zeros_like(bodies.velocity)
        if nodes.gravity is not None:
            holding = with_pins_held(contacts.holding[: len(graph.active)], pins, graph.geometry)
            lifted = lifted_fraction(lifted, holding, graph.geometry, capacity)
            # On a ground that is not described, bodies rest until an actuated one lifts them.
            falling = nodes.passive if described else lifted * (1.0 - nodes.actuated)
            gravity = jnp.pad(nodes.gravity, (0, coordinates - dimension))
            on_ground, falls = 1.0 - lifted, falling[:, None] * gravity
        of_edges = len(contacts.damper)
        if described:
            # What is held goes with the hand, and falls on no plane.
            driven = displaced + (1.0 - lifted[:, None]) * (dt * falls - displaced)
            planes = self._plane_contacts(braked.bodies, driven, theta=theta, dt=dt)
            contacts = contacts.and_also(planes)
            if nodes.gravity is not None:
                on_ground = on_planes(planes.geometry, nodes)
        damper, slowing = (on_ground * each for each in self.slowing(bodies.node_type))
        free = FreeBodies(
            mass=mass,
            velocity=braked.bodies.velocity,
            ground_damper=dt * damper,
            deceleration=slowing,
            weight=(mass * falls)[..., None],
            driving=driving.reshape(count, coordinates, -1),
            push=(mass * (nodes.actuated[:, None] * displaced + dt * falls))[..., None],
            speed=self.speed,
            pushed=not self.identified,
            lifted=lifted,
            sliding=self._sliding(bodies),
        )
        if self.identified:
            contacts = contacts.pushed_out(dt).pushing(free, dt, capacity)
        elif described:  # from a plane a hand may lift what it holds
            on_plane = jnp.arange(len(contacts.damper)) >= of_edges
            contacts = contacts.pushing(free, dt, capacity, on_plane)
        solution = contacts.solve(free, dt, capacity, self.rough)
        if nodes.reach is not None:
            solution = motion.kept_within_reach(
                solution, displaced, slots, graph, braked, theta=theta, dt=dt
            )
        parameters = motion.parameters(graph, slots, solution, theta=theta, dt=dt, speed=self.speed)
        if nodes.anchor is None:
            return parameters
        return with_hinge_springs(
            parameters,
            graph,
            contacts.coupling[: len(graph.active)],
            solution.velocity_change,
            theta=theta,
            dt=dt,
        )

    def _contacts(
        self,
        graph: EncodedGraph,
        message: Float[Array, "active 2 E W"],
        *,
        theta: Array,
        dt: float,
    ) -> Contacts:
        """Contacts of the edges."""
        # The sum over directions does not depend on which node is the first.
        out = jax.vmap(jax.vmap(self.edge))(jnp.sum(message, axis=1))
        contact, unilateral, rigid = (
            np.array([[getattr(each, name)] for each in graph.edge_types])
            for name in ("contact", "unilateral", "rigid")
        )
        geometry, weight = graph.contact_points, graph.active.T * contact
        points = geometry.edge_index.shape[1] // max(1, weight.shape[1])
        if points > 1:
            out = jnp.tile(out, (1, points, 1))
            near = as_near(geometry, graph.geometry, _NEAREST * self.length)
            weight = jnp.tile(weight, (1, points)) * near
        if unilateral.any():
            # A contact predicted too early: bodies do not meet, or their outlines are apart.
            early = geometry.approach > (tolerance := _EARLY * self.length)
            early |= self.identified & (geometry.distance - geometry.contact_distance > tolerance)
            weight = jnp.where(early & (geometry.fraction_after_impact == 0.0), 0.0, weight)
            nearer = geometry.approach + weighed_down(geometry, graph.bodies.nodes, dt)
            closing = jax.nn.sigmoid(nearer / (_ONE_SIDED * self.length))
            weight = jnp.where(unilateral, weight * closing, weight)
        touch = jnp.sum(weight * unilateral, axis=0)
        soft = weight * ~rigid  # The residue of a spring would push bodies in touch.
        starts = [
            _RIGID if each.rigid else -np.log(1.0 / each.coupling - 1.0)
            for each in graph.edge_types
        ]
        each = jax.nn.sigmoid(out[..., 0] + np.array(starts)[:, None])
        each = jnp.where(rigid, 1.0 - _SOFTEST * (not self.identified) * (1.0 - each), each)
        coupling = jnp.sum(weight * each, axis=0)
        rest = jnp.sum(weight * jax.nn.softplus(out[..., 2]), axis=0) * self.length
        elastic, friction = self.laws(graph.bodies.node_type, *geometry.edge_index)
        touching = touch / jnp.maximum(jnp.sum(weight, axis=0), _SMALL)
        bounce = touch * elastic
        # A contact that bounces is over in an instant.
        normal = geometry.normal + bounce[:, None] * (geometry.impact_normal - geometry.normal)
        square = jnp.sum(normal**2, axis=-1, keepdims=True)
        # It is 0 of what fills up a list of edges.
        normal = normal / jnp.sqrt(jnp.maximum(square, _SMALL))
        return Contacts(
            geometry=dataclasses.replace(geometry, normal=normal),
            damper=damper_of(coupling),
            spring=jnp.sum(soft * jax.nn.softplus(out[..., 1] - 6.0), axis=0),
            rest_length=rest,
            touching=touching,
            # Only a rigid bond begins by an impact; a soft one acts all through a step.
            displacing_fraction=self._displacing(geometry, theta) * (1.0 - jnp.sum(soft, axis=0)),
            acting=1.0 - touching * geometry.time_of_impact * self.averaged,
            bounce=bounce,
            friction=friction,
            until_impact=theta * geometry.time_of_impact**2 * (1.0 - self.averaged),
            pinned=jnp.zeros_like(touch),
        )

    def _plane_contacts(
        self, bodies: Bodies, driven: Float[Array, "N D"], *, theta: Array, dt: float
    ) -> Contacts:
        """Touches of nodes with planes, which need no belief; ``driven`` m/s is what comes to the
        velocity if they do not touch."""
        motion, distance = dt * (bodies.velocity + driven), self._plane_distance(bodies.node_type)
        geometry = plane_geometry(bodies, motion, distance, self.turn_length, self.length)
        nearer = geometry.approach / (_ONE_SIDED * self.length)
        closing = meets_plane(geometry) * jax.nn.sigmoid(nearer)
        bounce, friction = self.laws(bodies.node_type, geometry.edge_index[0])
        nothing = jnp.zeros_like(closing)
        return Contacts(
            geometry=geometry,
            damper=damper_of(closing),
            spring=nothing,
            rest_length=nothing,
            touching=nothing + 1.0,
            displacing_fraction=self._displacing(geometry, theta),
            acting=1.0 - geometry.time_of_impact * self.averaged,
            bounce=closing * bounce,
            friction=friction,
            until_impact=geometry.time_of_impact * (1.0 - self.averaged),
            pinned=nothing,
        )

    def _sliding(self, bodies: Bodies) -> Sliding | None:
        """Of hulls that a ground bears in space, see `FreeBodies.sliding`."""
        in_space = bodies.position.shape[1] == 6
        if not in_space or self.turn_length is None or bodies.nodes.gravity is None:
            return None
        return hull_sliding(bodies, self.turn_length, SLOW * self.speed)

    def _displacing(self, geometry: Geometry, theta: Array) -> Float[Array, " C"]:
        # Positions follow from velocities that are means.
        return (1.0 - self.averaged) * (geometry.fraction_after_impact - theta)


def pin_contacts(geometry: Geometry) -> Contacts:
    """Contacts that always act, in all directions, at the `pin_geometry`."""
    exists = pinned(geometry)
    nothing = jnp.zeros_like(exists)
    return Contacts(
        geometry=geometry,
        damper=damper_of(exists),
        spring=nothing,
        rest_length=nothing,
        touching=nothing,
        displacing_fraction=nothing,
        acting=nothing + 1.0,
        bounce=MAX_COUPLING * exists,
        friction=nothing,
        until_impact=nothing,
        pinned=exists,
    )
