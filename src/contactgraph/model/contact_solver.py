"""Masses coupled by springs and dampers, solved implicitly for one step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.model.block_inverse import MassMatrix, solve_block_diagonal, solve_dense, to_nodes
from contactgraph.model.collision import Geometry
from contactgraph.model.convex import Patch

_SLOW = 1e-4
"""See `FreeBodies.slow`, in units of speed."""


class ContactSolution(eqx.Module):
    """Effect of one step on every node, of the whole scene solved together."""

    velocity_change: Float[Array, "N D"]
    """Without any control, m/s."""
    impact_displacement: Float[Array, "N D"]
    """m; by how much impacts displace more than the change of velocity alone would."""
    response: Float[Array, "N D U"]
    """Acceleration by each component of the control, 1/kg."""
    own_share: Float[Array, " N"]
    """Share of its own momentum that a node keeps, in (0, 1]."""
    ground_share: Float[Array, " N"]
    """Share of its velocity that a node loses to the ground when all move alike, in [0, 1)."""
    acceleration: Float[Array, "N D"] | None
    """By constant forces, m/s^2; None where there are none."""


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
    patch: Patch | None = None
    """On which bodies slide. None: each as an ellipsoid of its inertia."""

    @property
    def slow(self) -> float:
        """Speed of bodies that friction stops within a step, m/s."""
        return _SLOW * self.speed


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
    unhindered_response: Float[Array, "N G W"]
    """The same, without edges that only touch."""
    own_share: Float[Array, "N G"]
    """Share of its own momentum that a node keeps, in (0, 1]."""
    ground_share: Float[Array, "N G"]
    """Share of its velocity that a node loses to the ground, in [0, 1)."""


class ContactSolver(eqx.Module):
    r"""Masses, dampers and springs of a whole scene.

    With J the matrix that maps the nodes' velocities to the edges' relative velocities at the
    points of contact (`Geometry.contact_jacobian`), the change of velocity in a step without
    control is

    $$ \Delta = -H^{-1} \big( J^T (\Lambda J v + dt\,\kappa s) + dt\,g v \big), \qquad
       H = M + dt\,g + J^T \Lambda J, \quad \Lambda = dt\,\lambda + dt^2 \kappa, $$

    with $\lambda$ the dampers and $\kappa$ the springs of the edges, s their stretch, and g the
    dampers to the ground. H is positive definite whatever the coefficients, so the step exists,
    and without springs it never gains kinetic energy. In the limit of stiff dampers bodies take
    their common velocity, momentum over mass, along any chain of edges.
    """

    mass: Float[Array, " N"]
    """kg"""
    ground_damper: Float[Array, " N"]
    """Dampers to the ground, times dt; kg."""
    damper: Float[Array, " E"]
    """Dampers of the edges, times dt; kg."""
    spring: Float[Array, " E"]
    """Springs of the edges, times dt^2; kg."""
    rest_length: Float[Array, " E"]
    """Rest lengths of the springs, m."""
    displacing_fraction: Float[Array, " E"]
    """Fraction of the step for which an edge's impact displaces, beyond what the discretization
    assumes of any change of velocity."""

    def solve(
        self,
        velocity: Float[Array, "N D"],
        gain: Float[Array, " N"],
        geometry: Geometry,
        dt: float,
        control_size: int,
        weight: Float[Array, "N D"] | None = None,
        group_capacity: int | None = None,
    ) -> ContactSolution:
        """One step of `dt` [s].

        `gain` is the force on a node for each newton of control, `weight` [N] a constant force.
        `group_capacity`: most nodes that are coupled; None: all are solved as one group. Component
        d of the control acts on degree of freedom d; components beyond those move nothing.
        """
        count, dimension = velocity.shape
        stiffness = self.damper + self.spring
        matrix = MassMatrix((self.mass + self.ground_damper)[:, None], stiffness, geometry)
        size = matrix.size

        def columns(vectors: Float[Array, "n D"]) -> Float[Array, "n d c"]:
            return vectors.reshape(vectors.shape[0], size, dimension // size)

        def at_nodes(on_edges: Float[Array, "E D"]) -> Float[Array, "N d c"]:
            return to_nodes(columns(on_edges), geometry, count)

        relative = geometry.relative_velocity
        stretch = geometry.displacement - self.rest_length[:, None] * geometry.direction
        impulse = stiffness[:, None] * relative + self.spring[:, None] * stretch / dt
        displacing = (self.displacing_fraction * self.damper)[:, None] * relative
        identity = jnp.eye(size, dtype=velocity.dtype)
        right = [
            at_nodes(impulse) + columns(self.ground_damper[:, None] * velocity),
            at_nodes(displacing),
            gain[:, None, None] * identity,
            self.ground_damper[:, None, None] * identity,
        ]
        if weight is not None:
            right.append(columns(weight))
        vectors = jnp.concatenate(right, axis=-1)
        if group_capacity is None:
            solved = solve_dense(matrix, vectors)
        else:
            solved = solve_block_diagonal(matrix, vectors, group_capacity)
        splits = np.cumsum([part.shape[-1] for part in right])[:-1].tolist()
        change, moved, response, ground, *weighed = jnp.split(solved.solution, splits, axis=-1)
        if size == 1:
            response = response * jnp.eye(dimension)
        return ContactSolution(
            velocity_change=-change.reshape(count, dimension),
            impact_displacement=-dt * moved.reshape(count, dimension),
            response=response @ jnp.eye(dimension, control_size),
            own_share=jnp.mean(solved.diagonal, axis=1) * self.mass,
            ground_share=jnp.trace(ground, axis1=1, axis2=2) / size,
            acceleration=weighed[0].reshape(count, dimension) if weighed else None,
        )


def lifted_fraction(
    actuated: Float[Array, " N"],
    coupling: Float[Array, " E"],
    geometry: Geometry,
    group_capacity: int | None = None,
) -> Float[Array, " N"]:
    """Lifted fraction of each node, in [0, 1]: the strongest chain of edges to an actuated node.

    `actuated` is 1 or 0, the `coupling` of an edge in [0, 1), a chain as strong as the product of
    its edges. `group_capacity`: most nodes that are coupled; None: no limit.
    """
    count, edge_index = actuated.shape[0], geometry.edge_index
    share = actuated.astype(coupling.dtype)
    if group_capacity is not None:
        for _ in range(group_capacity - 1):
            arriving = (coupling * share[edge_index[::-1]]).reshape(-1)
            best = jax.ops.segment_max(arriving, edge_index.reshape(-1), count)
            share = jnp.maximum(share, best)
        return share
    first, second = geometry.incidence(count)
    couplings = first.T @ (coupling[:, None] * second)
    couplings = couplings + couplings.T
    for _ in range(count - 1):
        share = jnp.maximum(share, jnp.max(couplings * share, axis=1))
    return share
