"""Contacts with a direction, bounce and friction, solved implicitly for one step."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from contactgraph.bodies.geometry import Geometry, Rows, joined
from contactgraph.bodies.mass_matrix import GroupCapacity, MassMatrix, MassMatrixSolution, solve
from contactgraph.dynamics.free_bodies import (
    ContactMotion,
    FreeBodies,
    ground_dampers,
    sliding_share,
    speed_of,
    yielding,
    yielding_alone,
)

MAX_COUPLING = 1.0 - 1e-3
"""Coupling of a damper that is a thousand times as stiff as a mass of 1 in a step."""
_LEAST_BOUNCE = 1e-3
"""By which is divided: with less, what presses bodies together keeps them together."""
_PUSHED_OUT = 0.02
"""s; within about which bodies with outlines that overlap are pushed apart."""
_LEAST_INVERSE = 1e-6
"""1/kg; of a body that nothing moves."""


class Contacts(eqx.Module):
    r"""Contacts with a direction: a hold acts along and across the normal, a touch pushes only.

    The change of velocity of a step without control is

    $$ \Delta = -H^{-1} (J^T \Lambda J + g) v - H_e^{-1} J^T \Lambda_e J v, \qquad
       H = M + g + J^T \Lambda J, \quad H_e = M + J^T \Lambda_e J, $$

    plus springs and weight, with $\Lambda$ the dampers along and across each normal, times dt, and
    $\Lambda_e = \mu\, e / (1 - e)$ along the normals, where $\mu$ is the reduced mass of the two
    bodies: a pair alone then bounces by e. Both matrices that act on v are symmetric in the metric
    M, with eigenvalues in [0, 1), so that kinetic energy never grows, whatever the coefficients.
    """

    geometry: Geometry
    damper: Float[Array, " C"]
    """Times dt, kg; along the normal, and across it where a contact holds."""
    spring: Float[Array, " C"]
    """Times dt^2, kg."""
    rest_length: Float[Array, " C"]
    """m"""
    touching: Float[Array, " C"]
    """1 where bodies only touch, 0 where they hold each other."""
    displacing_fraction: Float[Array, " C"]
    """Share of the step after the impact, less theta: what it displaces beyond its velocity."""
    acting: Float[Array, " C"]
    """Share of the change of velocity that the velocity after the step shows, in [0, 1]; 1 but for
    velocities that are means over the step in which bodies meet."""
    bounce: Float[Array, " C"]
    """e, in [0, 1): the share of the approach with which a touch parts."""
    friction: Float[Array, " C"]
    """Coulomb's coefficient of a touch."""
    until_impact: Float[Array, " C"]
    """Displacement by control and weight before the impact, in dt times what they add to v."""
    pinned: Float[Array, " C"]
    """1 for pins, whose ``bounce`` acts along all axes and both ways, else 0."""

    def solve(
        self, bodies: FreeBodies, dt: float, capacity: GroupCapacity | None, rough: bool = True
    ) -> ContactMotion:
        """One step of ``dt`` [s]; ``capacity``: most nodes that are coupled, None: no limit;
        ``rough``: whether anything bounces, rubs or decelerates; else one solution is enough.

        First without friction, which tells the normal impulses that bound it.
        """
        mass, count = bodies.mass, len(bodies.mass)
        slides = self.geometry.along(1.0 - self.touching)
        if not rough:
            ground = bodies.ground_damper[:, None] * mass
            return self._moved(bodies, slides, ground, jnp.zeros((*mass.shape, 2)), dt, capacity)
        normal = self._at_impact(self.geometry.along(self.pinned), bodies)
        stiffness, holding = self.damper + self.spring, 1.0 - self.touching
        mobility, mobility_across = self._mobility(mass)
        elastic = self.bounce / ((1.0 - self.bounce) * mobility)
        hindered = [self._impulse(slides, count, dt), bodies.push]
        rebounds = [
            _pulled(share * elastic, normal, count)
            for share in (self.displacing_fraction, self.acting)
        ]
        # Two scenes of the same bodies as one batch: one program to compile.
        found = _solved_each(
            mass,
            jnp.stack([stiffness, elastic]),
            [slides, normal],
            jnp.stack([jnp.concatenate(each, axis=-1) for each in (hindered, rebounds)]),
            capacity,
        )
        free, rebound = found.solution
        change = free[..., 1] - free[..., 0]
        sliding = sliding_share(bodies, self.geometry, self.coupling, dt)
        given = yielding_alone(bodies, change, found.diagonal[0])
        ground = ground_dampers(bodies, change, given, sliding, dt)
        if bodies.pushed:
            # What the ground takes from a body, that which pushes it gives, and more friction.
            braking = hindered[0] + (ground * bodies.velocity)[..., None]
            matrix = MassMatrix(mass + ground, stiffness, slides)
            right = jnp.concatenate([braking, bodies.push], axis=-1)
            braked = solve(matrix, right, capacity).solution
            slower = braked[..., 1] - braked[..., 0]
            given = yielding(bodies, ground, change, slower)
            ground, change = ground_dampers(bodies, change, given, sliding, dt), slower
        across = self._friction(bodies, change, mobility_across, dt)
        rubbing = self.geometry.along(jnp.maximum(across, holding))
        return self._moved(bodies, rubbing, ground, rebound, dt, capacity)

    def _moved(
        self,
        bodies: FreeBodies,
        rows: Geometry,
        ground: Float[Array, "N G"],
        rebound: Float[Array, "N G 2"],
        dt: float,
        capacity: GroupCapacity | None,
    ) -> ContactMotion:
        """The motion with dampers along and across the normals as of ``rows``, to the ``ground``
        [kg, times dt], and a ``rebound`` [m/s] that displaces, and that changes velocities."""
        mass, count = bodies.mass, len(bodies.mass)
        slowing = self._impulse(rows, count, dt) + (ground * bodies.velocity)[..., None]
        displacing = -self._left(self.until_impact, bodies.push - dt * bodies.borne, rows, mass)
        displacing += _pulled(self.displacing_fraction * self.damper, rows, count)
        driven = jnp.concatenate([bodies.weight, bodies.driving], axis=-1)
        unhindered = jnp.concatenate([bodies.weight - bodies.borne, bodies.driving], axis=-1)
        driven += self._left(1.0 - self.acting, unhindered, rows, mass)
        matrix = MassMatrix(mass + ground, self.damper + self.spring, rows)
        right = jnp.concatenate([slowing, displacing, driven], axis=-1)
        found = solve(matrix, right, capacity)
        return ContactMotion(
            velocity_change=-(found.solution[..., 0] + rebound[..., 1]),
            impact_displacement=-dt * (found.solution[..., 1] + rebound[..., 0]),
            acceleration=found.solution[..., 2],
            response=found.solution[..., 3:],
            own_share=found.diagonal * mass,
            ground_share=found.diagonal * ground,
        )

    @property
    def coupling(self) -> Float[Array, " C"]:
        """0 free to 1 rigid, for a mass of 1 kg."""
        return self.damper / (1.0 + self.damper)

    @property
    def holding(self) -> Float[Array, " C"]:
        """`coupling` where bodies hold each other, 0 where they touch."""
        return self.coupling * (1.0 - self.touching)

    def and_also(self, other: "Contacts") -> "Contacts":
        """These contacts, then the others."""
        if not len(other.damper):
            return self
        whole = self.geometry.along(jnp.ones_like(self.damper))
        return joined(dataclasses.replace(self, geometry=whole), other)

    @property
    def _gap(self) -> Float[Array, " C"]:
        return self.geometry.distance - self.geometry.contact_distance

    def pushed_out(self, dt: float) -> "Contacts":
        """These contacts, in which springs push out what overlaps."""
        overlaps = self._gap < 0.0
        spring = jnp.where(overlaps, dt / _PUSHED_OUT * self.touching * self.damper, self.spring)
        rest = jnp.where(overlaps, self.geometry.contact_distance, self.rest_length)
        return dataclasses.replace(self, spring=spring, rest_length=rest)

    def pushing(
        self,
        bodies: FreeBodies,
        dt: float,
        capacity: GroupCapacity | None,
        among: Bool[Array, " C"] | bool = True,
    ) -> "Contacts":
        """These contacts without touches that would pull, such as at the corner that lifts off
        where a block tips over: one round of an active set, ``among`` some of them."""
        geometry, gap = self.geometry, jnp.minimum(self._gap, 0.0)
        normal, stiffness = geometry.along(1.0 - self.touching), self.damper + self.spring
        pushed = bodies.push - self._impulse(normal, len(bodies.mass), dt)
        change = solve(MassMatrix(bodies.mass, stiffness, normal), pushed, capacity).solution
        parting = geometry.relative(bodies.velocity[..., None] + change)[..., 0]
        parting = jnp.sum(geometry.normal * parting, axis=-1)
        pulls = among & (stiffness * parting + self.spring * gap / dt > 0.0)
        kept = 1.0 - self.touching * pulls
        given = {name: kept * getattr(self, name) for name in ("damper", "spring", "bounce")}
        return dataclasses.replace(self, **given)

    def _at_impact(self, normal: Geometry, bodies: FreeBodies) -> Geometry:
        """With the velocity of which a bounce gives back its share: that at the impact, less what
        control and weight add to the approach after it, so that what is pushed on does not part."""
        added = normal.relative(bodies.push / bodies.mass[..., None])[..., 0]
        pushes = jnp.sum(normal.normal * added, axis=-1) < 0.0
        after = (1.0 - normal.time_of_impact) / jnp.maximum(self.bounce, _LEAST_BOUNCE) * pushes
        met = normal.relative_velocity + (normal.time_of_impact - after)[:, None] * added
        closing = jnp.sum(normal.normal * met, axis=-1, keepdims=True) < 0.0
        met = jnp.where(closing, met, 0.0)
        met = jnp.where(self.pinned[..., None] > 0.0, normal.relative_velocity, met)
        return dataclasses.replace(normal, relative_velocity=met)

    def _impulse(self, geometry: Geometry, count: int, dt: float) -> Float[Array, "N G 1"]:
        stretch = geometry.displacement - self.rest_length[:, None] * geometry.direction
        impulse = (self.damper + self.spring) * self.acting
        impulse = impulse[:, None] * geometry.relative_velocity
        impulse = impulse + self.spring[:, None] * stretch / dt
        return geometry.to_nodes(impulse[..., None], count)

    def _left(
        self, share: Float[Array, " C"], momentum: Array, geometry: Geometry, mass: Array
    ) -> Float[Array, "N G c"]:
        """Momentum [kg m/s] of the contacts that keeps this share of what would be without them."""
        free = geometry.relative(momentum / mass[..., None])
        return geometry.to_nodes((share * self.damper)[:, None, None] * free, len(mass))

    def _mobility(self, mass: Float[Array, "N G"]) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
        """Relative velocity of two free bodies for each unit of momentum between them, along the
        normal and, on average, across it; 1/kg."""
        jacobian = self.geometry.contact_jacobian
        if jacobian.shape[-1] == 1:
            jacobian = jacobian * jnp.eye(mass.shape[1])
        per_row = jacobian**2 / mass[self.geometry.edge_index][:, :, None]
        normal = jnp.einsum("ei,seij->sej", self.geometry.normal, jacobian)
        along = jnp.sum(normal**2 / mass[self.geometry.edge_index], axis=(0, 2))
        total = jnp.sum(per_row, axis=(0, 2, 3))
        across = (total - along) / (self.geometry.normal.shape[1] - 1)
        return jnp.maximum(along, _LEAST_INVERSE), jnp.maximum(across, _LEAST_INVERSE)

    def _friction(
        self,
        bodies: FreeBodies,
        change: Float[Array, "N G"],
        mobility: Float[Array, " C"],
        dt: float,
    ) -> Float[Array, " C"]:
        """The roots of the dampers across each normal, in units of those along it, by which
        friction reaches its bound and not more: see `ground_dampers`."""
        velocity, mobility, damper = jax.lax.stop_gradient(
            (bodies.velocity + change, mobility, self.damper)
        )
        relative = self.geometry.relative(velocity[..., None])[..., 0]
        approach = jnp.sum(self.geometry.normal * relative, axis=-1)
        across = speed_of(relative - approach[:, None] * self.geometry.normal, bodies.speed)
        pushed = -(damper + self.spring) * approach - self.spring * self._gap / dt
        normal_impulse = (1.0 + self.bounce) * jnp.maximum(pushed, 0.0)
        bound = self.friction * self.touching * normal_impulse
        tangential = bound / jnp.maximum(across - bound * mobility, bodies.slow)
        share = tangential / jnp.maximum(damper, _LEAST_INVERSE)
        return jnp.sqrt(jnp.clip(share, _LEAST_INVERSE**2, 1.0))


def damper_of(coupling: Float[Array, " C"]) -> Float[Array, " C"]:
    """The damper, times dt [kg], of a coupling from 0 free to 1 as rigid as there is."""
    return MAX_COUPLING * coupling / (1.0 - MAX_COUPLING * coupling)


def _solved_each(
    mass: Float[Array, "N G"],
    stiffness: Float[Array, "S C"],
    rows: Sequence[Rows],
    right: Float[Array, "S N G c"],
    capacity: GroupCapacity | None,
) -> MassMatrixSolution:
    """The solutions, [S, ...], of several scenes of the same bodies, which differ in their rows."""

    def one(stiffness: Array, jacobian: Array, right: Array) -> MassMatrixSolution:
        matrix = MassMatrix(mass, stiffness, Rows(rows[0].edge_index, jacobian))
        return solve(matrix, right, capacity)

    return jax.vmap(one)(stiffness, jnp.stack([each.contact_jacobian for each in rows]), right)


def _pulled(damper: Float[Array, " C"], geometry: Geometry, count: int) -> Float[Array, "N G 1"]:
    return geometry.to_nodes((damper[:, None] * geometry.relative_velocity)[..., None], count)
