"""Contacts with a direction, bounce and friction, solved implicitly for one step."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from contactgraph.bodies.geometry import Geometry, relative_at_edges, to_nodes
from contactgraph.bodies.graph import GroupCapacity
from contactgraph.bodies.mass_matrix import MassMatrix, MassMatrixSolution, solve_dense
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
    pinned: Float[Array, " C"] | float = 0.0
    """1 for pins, whose ``bounce`` acts along all axes and both ways, else 0."""

    def solve(
        self, bodies: FreeBodies, dt: float, capacity: GroupCapacity | None, rough: bool = True
    ) -> ContactMotion:
        """One step of ``dt`` [s]; ``capacity``: most nodes that are coupled, None: no limit;
        ``rough``: whether anything bounces, rubs or decelerates; else one solution is enough.

        First without friction, which tells the normal impulses that bound it.
        """
        if not rough:
            return self._solve_smooth(bodies, dt, capacity)
        mass, count = bodies.mass, len(bodies.mass)
        slides = self.geometry.along(1.0 - self.touching)
        normal = self._at_impact(self.geometry.along(self.pinned + 0.0 * self.damper), bodies)
        stiffness, holding = self.damper + self.spring, 1.0 - self.touching
        mobility, mobility_across = self._mobility(mass)
        elastic = self.bounce / ((1.0 - self.bounce) * mobility)
        rebounds = [self.displacing_fraction * elastic, self.acting * elastic]
        first, rebound = _solve_each(
            mass,
            [stiffness, elastic],
            [slides, normal],
            [
                [self._impulse(slides, count, dt), bodies.push],
                [_pulled(each, normal, count) for each in rebounds],
            ],
            capacity,
        )
        change = jnp.sum(first.parts[1] - first.parts[0], axis=-1)
        sliding = sliding_share(bodies, self.geometry, self.coupling, dt)
        given = yielding_alone(bodies, change, first.diagonal)
        ground = ground_dampers(bodies, change, given, sliding, dt)
        if bodies.pushed:
            # What the ground takes from a body, that which pushes it gives, and more friction.
            braking = self._impulse(slides, count, dt) + (ground * bodies.velocity)[..., None]
            braked = _solve(mass + ground, stiffness, slides, [braking, bodies.push], capacity)
            slower = jnp.sum(braked.parts[1] - braked.parts[0], axis=-1)
            given = yielding(bodies, ground, change, slower)
            ground, change = ground_dampers(bodies, change, given, sliding, dt), slower
        across = self._friction(bodies, change, mobility_across, dt)
        rubbing = self.geometry.along(jnp.maximum(across, holding))
        slowing = self._impulse(rubbing, count, dt) + (ground * bodies.velocity)[..., None]
        displacing = -self._left(self.until_impact, bodies.push, rubbing, mass)
        displacing += _pulled(self.displacing_fraction * self.damper, rubbing, count)
        driven = jnp.concatenate([bodies.weight, bodies.driving], axis=-1)
        driven += self._left(1.0 - self.acting, driven, rubbing, mass)
        solved = _solve(mass + ground, stiffness, rubbing, [slowing, displacing, driven], capacity)
        return ContactMotion(
            velocity_change=-jnp.sum(solved.parts[0] + rebound.parts[1], axis=-1),
            impact_displacement=-dt * jnp.sum(solved.parts[1] + rebound.parts[0], axis=-1),
            acceleration=solved.parts[2][..., 0],
            response=solved.parts[2][..., 1:],
            own_share=solved.diagonal * mass,
            ground_share=solved.diagonal * ground,
        )

    def _solve_smooth(
        self, bodies: FreeBodies, dt: float, capacity: GroupCapacity | None
    ) -> ContactMotion:
        """`solve` where nothing bounces, rubs or is slowed but by dampers: at once."""
        mass, count = bodies.mass, len(bodies.mass)
        sliding, stiffness = self.geometry.along(1.0 - self.touching), self.damper + self.spring
        ground = bodies.ground_damper[:, None] * mass
        slowing = self._impulse(sliding, count, dt) + (ground * bodies.velocity)[..., None]
        displacing = -self._left(self.until_impact, bodies.push, sliding, mass)
        displacing += _pulled(self.displacing_fraction * self.damper, sliding, count)
        driven = jnp.concatenate([bodies.weight, bodies.driving], axis=-1)
        driven += self._left(1.0 - self.acting, driven, sliding, mass)
        solved = _solve(mass + ground, stiffness, sliding, [slowing, displacing, driven], capacity)
        return ContactMotion(
            velocity_change=-solved.parts[0][..., 0],
            impact_displacement=-dt * jnp.sum(solved.parts[1], axis=-1),
            acceleration=solved.parts[2][..., 0],
            response=solved.parts[2][..., 1:],
            own_share=solved.diagonal * mass,
            ground_share=solved.diagonal * ground,
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
        whole = self.geometry.along(jnp.ones_like(self.damper))
        first = dataclasses.replace(self, geometry=whole, pinned=self.pinned + 0.0 * self.damper)
        other = dataclasses.replace(other, pinned=other.pinned + 0.0 * other.damper)

        by_end = ("edge_index", "contact_jacobian")  # the two ends are the first axis

        def joined(path: tuple, one: Array, another: Array) -> Array:
            return jnp.concatenate([one, another], axis=int(path[-1].name in by_end))

        return jax.tree_util.tree_map_with_path(joined, first, other)

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
        solved = _solve(bodies.mass, stiffness, normal, [pushed], capacity)
        velocity = bodies.velocity[..., None] + solved.parts[0]
        parting = jnp.sum(geometry.normal * relative_at_edges(velocity, geometry)[..., 0], axis=-1)
        pulls = among & (stiffness * parting + self.spring * gap / dt > 0.0)
        kept = 1.0 - self.touching * pulls
        given = {name: kept * getattr(self, name) for name in ("damper", "spring", "bounce")}
        return dataclasses.replace(self, **given)

    def _at_impact(self, normal: Geometry, bodies: FreeBodies) -> Geometry:
        """With the velocity of which a bounce gives back its share: that at the impact, less what
        control and weight add to the approach after it, so that what is pushed on does not part."""
        added = relative_at_edges(bodies.push / bodies.mass[..., None], normal)[..., 0]
        pushes = jnp.sum(normal.normal * added, axis=-1) < 0.0
        after = (1.0 - normal.time_of_impact) / jnp.maximum(self.bounce, _LEAST_BOUNCE) * pushes
        met = normal.relative_velocity + (normal.time_of_impact - after)[:, None] * added
        closing = jnp.sum(normal.normal * met, axis=-1, keepdims=True) < 0.0
        met = jnp.where(closing, met, 0.0)
        met = jnp.where(jnp.asarray(self.pinned)[..., None] > 0.0, normal.relative_velocity, met)
        return dataclasses.replace(normal, relative_velocity=met)

    def _impulse(self, geometry: Geometry, count: int, dt: float) -> Float[Array, "N G 1"]:
        stretch = geometry.displacement - self.rest_length[:, None] * geometry.direction
        impulse = (self.damper + self.spring) * self.acting
        impulse = impulse[:, None] * geometry.relative_velocity
        impulse = impulse + self.spring[:, None] * stretch / dt
        return to_nodes(impulse[..., None], geometry, count)

    def _left(
        self, share: Float[Array, " C"], momentum: Array, geometry: Geometry, mass: Array
    ) -> Float[Array, "N G c"]:
        """Momentum [kg m/s] of the contacts that keeps this share of what would be without them."""
        free = relative_at_edges(momentum / mass[..., None], geometry)
        return to_nodes((share * self.damper)[:, None, None] * free, geometry, len(mass))

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
        relative = relative_at_edges(velocity[..., None], self.geometry)[..., 0]
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


class _Solved(eqx.Module):
    parts: list[Float[Array, "N G c"]]
    diagonal: Float[Array, "N G"]


def _solve_each(
    node: Float[Array, "N G"],
    stiffness: list[Float[Array, " C"]],
    geometry: list[Geometry],
    vectors: list[list[Float[Array, "N G c"]]],
    capacity: GroupCapacity | None,
) -> list[_Solved]:
    """`_solve` of several scenes of the same bodies, as one batch: one program to compile."""
    widths = [sum(part.shape[-1] for part in parts) for parts in vectors]
    padded = []
    for parts, width in zip(vectors, widths, strict=True):
        filling = jnp.zeros((*parts[0].shape[:-1], max(widths) - width), parts[0].dtype)
        padded.append(jnp.concatenate([*parts, filling], axis=-1))

    def solve(stiffness: Array, jacobian: Array, right: Array) -> _Solved:
        at = dataclasses.replace(geometry[0], contact_jacobian=jacobian)
        return _solve(node, stiffness, at, [right], capacity)

    jacobians = jnp.stack([each.contact_jacobian for each in geometry])
    batch = jax.vmap(solve)(jnp.stack(stiffness), jacobians, jnp.stack(padded))
    results = []
    for index, parts in enumerate(vectors):
        ends = np.cumsum([part.shape[-1] for part in parts]).tolist()
        split = jnp.split(batch.parts[0][index], ends, axis=-1)[:-1]
        results.append(_Solved(split, batch.diagonal[index]))
    return results


def _solve(
    node: Float[Array, "N G"],
    stiffness: Float[Array, " C"],
    geometry: Geometry,
    vectors: list[Float[Array, "N G c"]],
    capacity: GroupCapacity | None,
) -> _Solved:
    matrix, right = MassMatrix(node, stiffness, geometry), jnp.concatenate(vectors, axis=-1)
    found = solved(matrix, right, capacity)
    splits = np.cumsum([part.shape[-1] for part in vectors])[:-1].tolist()
    return _Solved(jnp.split(found.solution, splits, axis=-1), found.diagonal)


def solved(
    matrix: MassMatrix, vectors: Float[Array, "N d c"], capacity: GroupCapacity | None
) -> MassMatrixSolution:
    """By groups of coupled nodes of this ``capacity``; None: all at once."""
    return solve_dense(matrix, vectors) if capacity is None else capacity.solve(matrix, vectors)


def _pulled(damper: Float[Array, " C"], geometry: Geometry, count: int) -> Float[Array, "N G 1"]:
    return to_nodes((damper[:, None] * geometry.relative_velocity)[..., None], geometry, count)
