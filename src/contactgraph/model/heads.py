"""From node embeddings and messages to the spring-mass-damper parameters of every node."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.model.geometry import Geometry
from contactgraph.model.spring_mass_damper import SpringMassDamper

_SMALLEST = 1e-6


class CoupledHead(eqx.Module):
    r"""Parameters as springs and dampers between nodes: what no rotation of the scene changes.

    Every active edge is a spring of stiffness rate $\kappa_{ij}$ and rest length $\ell_{ij}$, a
    damper of rate $\gamma_{ij}$, and a shift; every node has a mass and a damper to the ground.
    Seen from node i these add up to one spring-mass-damper (isotropic, so it needs no axes):

    $$ \kappa_i = \sum_j \kappa_{ij}, \quad
       \hat x_i = \frac{1}{\kappa_i} \sum_j \kappa_{ij} (x_j - \ell_{ij} n_{ij}), \quad
       \gamma_i = \gamma_{i0} + \sum_j \gamma_{ij}, \quad
       \hat v_i = \frac{1}{\gamma_i} \sum_j \gamma_{ij} v_j $$

    A purely inelastic impact is a damper that is stiff for one step.
    """

    node: eqx.nn.MLP
    edge: eqx.nn.MLP
    width: int = eqx.field(static=True)
    length: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    def __init__(self, width: int, *, length: float, dt: float, key: PRNGKeyArray):
        node_key, edge_key = jax.random.split(key)
        self.node = eqx.nn.MLP(width, 2, width, 1, key=node_key)
        self.edge = eqx.nn.MLP(width, 5, width, 1, key=edge_key)
        self.width = width
        self.length = length
        self.dt = dt

    def __call__(
        self,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        weight: Float[Array, "E active"],
        geometry: Geometry,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        count, dimension = position.shape
        own = jax.vmap(self.node)(embedding)
        inverse_mass = jax.nn.softplus(own[:, :1])
        ground = jax.nn.softplus(own[:, 1:] - 4.0) / self.dt
        per_type = jax.vmap(jax.vmap(jax.vmap(self.edge)))(message)
        coupling = jnp.einsum("ke,kden->den", weight.T, _edge_parameters(per_type))
        stiffness = coupling[..., :1] / self.dt**2
        damping = coupling[..., 1:2] / self.dt
        direction = jnp.stack([geometry.direction, -geometry.direction])
        relative = jnp.stack([geometry.relative_velocity, -geometry.relative_velocity])
        displacement = jnp.stack([geometry.displacement, -geometry.displacement])
        stretch = displacement - self.length * coupling[..., 2:3] * direction
        late = geometry.share_after_touch[:, None]
        shift = (coupling[..., 3:4] + coupling[..., 4:5] * late) * self.dt * relative
        ends = jnp.stack([geometry.first, geometry.second])
        summed = _sum_at_nodes(
            jnp.concatenate(
                [stiffness, damping, stiffness * stretch, damping * relative, shift], axis=-1
            ),
            ends,
            count,
        )
        total_stiffness, total_damping = summed[:, :1], summed[:, 1:2]
        pull, drag, moved = jnp.split(summed[:, 2:], 3, axis=-1)
        total_damping = total_damping + ground
        ones = jnp.ones((1, dimension), position.dtype)
        return SpringMassDamper(
            inverse_mass=inverse_mass * ones,
            stiffness_rate=total_stiffness * ones,
            damping_rate=total_damping * ones,
            equilibrium=position + pull / jnp.maximum(total_stiffness, _SMALLEST),
            equilibrium_velocity=velocity
            + (drag - ground * velocity) / jnp.maximum(total_damping, _SMALLEST),
            shift=moved,
        )


class PerDegreeHead(eqx.Module):
    """The paper's head: 1/m, k, c and equilibrium of every node and degree of freedom, freely.

    The equilibrium is relative to the node's own position. Parameters are positive.
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
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        weight: Float[Array, "E active"],
        geometry: Geometry,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        out = jax.vmap(self.node)(embedding).reshape(-1, 4, self.dimension)
        return SpringMassDamper(
            inverse_mass=5.0 * jax.nn.sigmoid(out[:, 0]),
            stiffness_rate=5.0 * jax.nn.sigmoid(out[:, 1]),
            damping_rate=5.0 * jax.nn.sigmoid(out[:, 2]),
            equilibrium=position + out[:, 3],
            equilibrium_velocity=jnp.zeros_like(velocity),
            shift=jnp.zeros_like(position),
        )


def _edge_parameters(out: Float[Array, "active 2 E 5"]) -> Float[Array, "active 2 E 5"]:
    """Stiffness, damping and rest length are positive; how an impact shifts a position is free."""
    positive = jax.nn.softplus(out[..., :3] - jnp.array([4.0, 0.0, 0.0]))
    return jnp.concatenate([positive, out[..., 3:]], axis=-1)


def _sum_at_nodes(values: Float[Array, "2 E F"], ends: Array, count: int) -> Float[Array, "N F"]:
    arrives = (jnp.arange(count)[:, None] == ends.reshape(-1)).astype(values.dtype)
    return arrives @ values.reshape(-1, values.shape[-1])
