"""Masses joined by springs and dampers, solved implicitly for one step."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.model.block_inverse import (
    Inertia,
    solve_block_diagonal,
    solve_dense,
    to_nodes,
)
from contactgraph.model.collision import Geometry


class ContactSolution(eqx.Module):
    """What one step does to every node, as the whole network has it."""

    change: Float[Array, "N D"]
    """Change of velocity when nothing pushes, m/s."""
    impact_displacement: Float[Array, "N D"]
    """m; by how much impacts displace more than the change of velocity alone would."""
    response: Float[Array, "N D U"]
    """Acceleration by each component of the control, 1/kg."""
    own_share: Float[Array, " N"]
    """What part of its own momentum a node keeps, in (0, 1]."""
    ground_share: Float[Array, " N"]
    """What part of its velocity a node loses to the ground when all move alike, in [0, 1)."""
    acceleration: Float[Array, "N D"] | None
    """By forces that always act, m/s^2; None where there are none."""


class ContactSolver(eqx.Module):
    r"""Masses, dampers and springs of a whole scene.

    With J the matrix that takes the nodes' velocities to the edges' relative velocities where the
    bodies meet (`Geometry.contact_jacobian`), the change of velocity in a step without forces is

    $$ \Delta = -H^{-1} \big( J^T (\Lambda J v + dt\,\kappa s) + dt\,g v \big), \qquad
       H = M + dt\,g + J^T \Lambda J, \quad \Lambda = dt\,\lambda + dt^2 \kappa, $$

    with $\lambda$ the dampers and $\kappa$ the springs of the edges, s their stretch, and g the
    dampers to the ground. H is positive definite whatever the coefficients, so the step exists,
    and without springs it never gains kinetic energy. In the limit of stiff dampers bodies take
    their common velocity, momentum over mass, along any chain of edges.
    """

    mass: Float[Array, " N"]
    """kg"""
    ground: Float[Array, " N"]
    """Dampers to the ground, times dt; kg."""
    hold: Float[Array, " E"]
    """Dampers of the edges, times dt; kg."""
    spring: Float[Array, " E"]
    """Springs of the edges, times dt^2; kg."""
    rest: Float[Array, " E"]
    """Rest lengths of the springs, m."""
    displacing_fraction: Float[Array, " E"]
    """Part of the step for which an edge's impact displaces, beyond what the discretization takes
    any change of velocity to do."""

    def step(
        self,
        velocity: Float[Array, "N D"],
        gain: Float[Array, " N"],
        geometry: Geometry,
        dt: float,
        control_size: int,
        weight: Float[Array, "N D"] | None = None,
        group_capacity: int | None = None,
    ) -> ContactSolution:
        """One step of `dt` [s]; `gain` is the force on a node for each newton of control, `weight`
        [N] a force that always acts. `room`: for so many nodes that hold each other; None: all."""
        count, dimension = velocity.shape
        inertia = Inertia(self.mass + self.ground, self.hold + self.spring, geometry)
        size = inertia.size

        def columns(momentum: Float[Array, "N D"]) -> Float[Array, "N d c"]:
            return momentum.reshape(count, size, -1)

        def sum_at_nodes(on_edges: Float[Array, "E D"]) -> Float[Array, "N d c"]:
            on_edges = on_edges.reshape(on_edges.shape[0], size, -1)
            return to_nodes(on_edges, geometry, count)

        relative = geometry.relative_velocity
        stretch = geometry.displacement - self.rest[:, None] * geometry.direction
        impulse = (self.hold + self.spring)[:, None] * relative
        impulse = impulse + self.spring[:, None] * stretch / dt
        displacing = (self.displacing_fraction * self.hold)[:, None] * relative
        each = jnp.eye(size, dtype=velocity.dtype)
        right = [
            sum_at_nodes(impulse) + columns(self.ground[:, None] * velocity),
            sum_at_nodes(displacing),
            gain[:, None, None] * each,
            self.ground[:, None, None] * each,
        ]
        if weight is not None:
            right.append(columns(weight))
        vectors = jnp.concatenate(right, axis=-1)
        if group_capacity is None:
            solved = solve_dense(inertia, vectors)
        else:
            solved = solve_block_diagonal(inertia, vectors, group_capacity)
        ends = np.cumsum([part.shape[-1] for part in right])[:-1].tolist()
        change, shift, response, ground, *weighed = jnp.split(solved.solution, ends, axis=-1)
        if size == 1:
            response = response * jnp.eye(dimension)
        return ContactSolution(
            change=-change.reshape(count, dimension),
            impact_displacement=-dt * shift.reshape(count, dimension),
            response=response @ jnp.eye(dimension, control_size),
            own_share=solved.own * self.mass,
            ground_share=jnp.trace(ground, axis1=1, axis2=2) / size,
            acceleration=weighed[0].reshape(count, dimension) if weighed else None,
        )
