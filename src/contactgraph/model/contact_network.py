"""Masses joined by springs and dampers, solved implicitly for one step."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.model.geometry import Geometry


class GroupMotion(eqx.Module):
    """What one step does to every node, as the whole network has it."""

    change: Float[Array, "N D"]
    """Change of velocity when nothing pushes, m/s."""
    shift: Float[Array, "N D"]
    """m; by how much impacts displace more than the change of velocity alone would."""
    response: Float[Array, "N D U"]
    """Acceleration by each component of the control, 1/kg."""
    own_share: Float[Array, " N"]
    """What part of its own momentum a node keeps, in (0, 1]."""
    ground_share: Float[Array, " N"]
    """What part of its velocity a node loses to the ground when all move alike, in [0, 1)."""
    acceleration: Float[Array, "N D"] | None
    """By forces that always act, m/s^2; None where there are none."""


class ContactNetwork(eqx.Module):
    r"""Masses, dampers and springs of a whole scene.

    With J the matrix that takes the nodes' velocities to the edges' relative velocities where the
    bodies meet (`Geometry.lever`), the change of velocity in a step in which nothing pushes is

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
    displaces: Float[Array, " E"]
    """For what part of the step an edge's impact displaces, beyond what the discretisation takes
    any change of velocity to do."""

    def step(
        self,
        velocity: Float[Array, "N D"],
        gain: Float[Array, " N"],
        geometry: Geometry,
        dt: float,
        control_size: int,
        weight: Float[Array, "N D"] | None = None,
    ) -> GroupMotion:
        """One step of `dt` [s]; `gain` is the force on a node for each newton of control, `weight`
        [N] a force that always acts."""
        count, dimension = velocity.shape
        jacobian = _jacobian(geometry, count)
        size = geometry.lever.shape[-1]

        def at_nodes(on_edges: Float[Array, "E D"]) -> Float[Array, "N D"]:
            flat = on_edges.reshape(jacobian.shape[0], -1)
            return (jacobian.T @ flat).reshape(count, dimension)

        def moved(momentum: Float[Array, "N D"]) -> Float[Array, "N D"]:
            return (inverse @ momentum.reshape(count * size, -1)).reshape(count, dimension)

        stiff = jnp.repeat(self.hold + self.spring, size)
        inertia = jnp.repeat(self.mass + self.ground, size)
        inverse = jnp.linalg.inv(jacobian.T @ (stiff[:, None] * jacobian) + jnp.diag(inertia))
        relative = geometry.relative_velocity
        stretch = geometry.displacement - self.rest[:, None] * geometry.direction
        impulse = (self.hold + self.spring)[:, None] * relative
        impulse = impulse + self.spring[:, None] * stretch / dt
        displacing = (self.displaces * self.hold)[:, None] * relative

        blocks = inverse.reshape(count, size, count, size)
        response = jnp.einsum("ndmk,m->ndk", blocks, gain)
        if size == 1:
            response = response * jnp.eye(dimension)
        own = jnp.einsum("ndnd->n", blocks) / size
        ground = jnp.einsum("ndmd,m->n", blocks, self.ground) / size
        return GroupMotion(
            change=-moved(at_nodes(impulse) + self.ground[:, None] * velocity),
            shift=-dt * moved(at_nodes(displacing)),
            response=response @ jnp.eye(dimension, control_size),
            own_share=own * self.mass,
            ground_share=ground,
            acceleration=None if weight is None else moved(weight),
        )


def _jacobian(geometry: Geometry, count: int) -> Float[Array, "Ed Nd"]:
    """From all velocities to the relative velocities along all edges."""
    lever = geometry.lever
    size = lever.shape[-1]
    first, second = geometry.ends(count)
    blocks = second[:, None, :, None] * lever[1][:, :, None, :]
    blocks = blocks - first[:, None, :, None] * lever[0][:, :, None, :]
    return blocks.reshape(-1, count * size)
