"""Types of bodies: masses, what the ground takes, and their motion without contacts in a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.bodies.geometry import Rows, joined
from contactgraph.bodies.graph import Bodies
from contactgraph.bodies.mass_matrix import GroupCapacity, MassMatrix, solve
from contactgraph.bodies.pins import pin_meeting, pinned, with_closed_pins
from contactgraph.bodies.planes import rests_on_planes
from contactgraph.bodies.rotations import stepped_turns
from contactgraph.dynamics.actuation import ActuatedMotion, Actuation
from contactgraph.dynamics.contacts import damper_of

PACE = 5.0
"""Scale of each type's numbers in their parameters, which learn faster than weights by this."""
DECELERATION = 10.0
"""Unit of decelerations by the ground, in units of speed a second."""
_PLANE_LEARNED = 0.1
"""Learned part of the distance from planes, as a share of what the data tell."""
_SMALL = 1e-6


class BodyTypes(eqx.Module):
    """Each node type's mass, inertia, and deceleration by the ground, and its actuation."""

    log_mass: Float[Array, " types"]
    """Of the mass in kg, in units of `PACE`; motion determines masses up to a common factor."""
    damper_raw: Float[Array, " types"]
    """Of the damper to the ground, 1/s: softplus(`PACE` x - 6)."""
    deceleration_raw: Float[Array, " types"]
    """Of the deceleration by the ground, in units of `DECELERATION`: softplus(`PACE` x - 6)."""
    log_inertia: Float[Array, "types ..."] | None
    """Of squared radii of gyration by `turn_length`, in space about axes, over `PACE`; or none."""
    log_spread: Float[Array, " types"] | None
    """Of the spread of log masses in a type, in units of `PACE`, or none."""
    plane_distance: Float[Array, " types"]
    """m, of a node from a plane that it touches, by the data; a tenth of it is learned."""
    plane_raw: Float[Array, " types"]
    actuation: Actuation
    length: float = eqx.field(static=True)
    rough: bool = eqx.field(static=True)
    speed: float = eqx.field(static=True)
    turn_length: float | None = eqx.field(static=True)
    told: tuple[str, ...] = eqx.field(static=True)
    """Parameters that trajectories told directly, and that are not learned: gradients through
    impacts are noise, and lead away from them."""

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

    def _learned(self, name: str) -> Float[Array, " types"]:
        """The parameter, without a gradient where `told` has it."""
        raw = getattr(self, name)
        return jax.lax.stop_gradient(raw) if name in self.told else raw

    def coasting(self, bodies: Bodies, dt: float) -> Float[Array, "N G"]:
        """Velocity of every node after a step of ``dt`` [s] in which only the ground slows it; with
        weight as given, but in space, where outlines tell which bodies lie on a plane."""
        damper, slowing = self.slowing(bodies.node_type)
        if bodies.nodes.gravity is not None:
            if bodies.nodes.planes is None or bodies.velocity.shape[1] != 6:
                return bodies.velocity
            distance = self._plane_distance(bodies.node_type)
            on_ground = rests_on_planes(bodies, distance, self.turn_length, self.length, dt)
            damper, slowing = on_ground * damper, on_ground * slowing
        ratio = self.mass_ratio(bodies.node_type, bodies.velocity.shape[1])
        energy = jnp.sum(ratio * bodies.velocity**2, axis=-1)
        speed = jnp.sqrt(energy + (_SMALL * self.speed) ** 2)
        left = jax.nn.relu(1.0 - dt * slowing / speed) / (1.0 + dt * damper)
        return jax.lax.stop_gradient(left)[:, None] * bodies.velocity

    def control_displacement(
        self,
        bodies: Bodies,
        control: Float[Array, " U"],
        held: Rows,
        holds: Float[Array, " C"],
        *,
        theta: Array,
        dt: float,
        capacity: GroupCapacity | None,
    ) -> Float[Array, "N G"]:
        """m; how far the control alone moves each node in a step, with what ``holds`` (1, else 0).

        A force of 10 N moves a body of 1 kg by 14 mm in a step of 0.05 s, which decides whether it
        touches another within the step. Bodies that hold each other count as rigid. No gradient
        reaches the parameters.
        """
        motion = self.actuation(bodies, theta, dt)
        mass = self._coordinate_mass(bodies, motion)
        mass, theta = jax.lax.stop_gradient((mass, theta))
        free = motion.by_control @ control[: self.actuation.control_size] + motion.constant
        pins = pin_meeting(bodies, self.turn_length)
        if len(pins.displacement):
            held = joined(held, Rows(pins.edge_index, pins.contact_jacobian))
            holds = jnp.concatenate([holds, pinned(pins)])
        if not len(holds):
            return theta * dt**2 * free
        size = held.contact_jacobian.shape[-1]
        matrix = MassMatrix(mass[:, :size], damper_of(holds), held)
        return theta * dt**2 * solve(matrix, (mass * free)[..., None], capacity).solution[..., 0]

    def retract(self, before: Bodies, after: Bodies, *, theta: Array, dt: float) -> Bodies:
        """The bodies after a step, from those by linear dynamics: turns in space are composed, and
        the points of each pin brought together."""
        if self.turn_length is None:
            return after
        if after.position.shape[1] == 6:
            place = stepped_turns(before.position, after.position, self.turn_length)
            after = after._replace(position=place)
        if before.nodes.pins is None:
            return after
        mass = self._coordinate_mass(before, self.actuation(before, theta, dt))
        return with_closed_pins(after, mass, self.turn_length)

    def _coordinate_mass(self, bodies: Bodies, motion: ActuatedMotion) -> Float[Array, "N G"]:
        """kg; of every coordinate of every node, with what a servo adds."""
        own = 0.0 if bodies.nodes.log_mass is None else bodies.nodes.log_mass
        mass = self.mass(bodies.node_type, own) * motion.inertia
        return mass[:, None] * self.mass_ratio(bodies.node_type, bodies.position.shape[1])

    def _plane_distance(self, node_type: Float[Array, "N types"]) -> Float[Array, " N"]:
        # Bodies that rest do not tell how much farther a plane might be.
        part = 1.0 + _PLANE_LEARNED * jnp.tanh(PACE * self.plane_raw)
        return node_type @ (jax.lax.stop_gradient(self.plane_distance) * part)
