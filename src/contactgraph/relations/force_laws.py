r"""Local dynamics of relations without contact: bodies act on each other along their displacement.

With r the displacement from body i to body j, $\tau$ their types and p the weight of each
edge type a,

$$ \dot v_i = w u - \gamma_{\tau_i} v_i
   + \sum_{j, a} p_{ij,a}\, s_a(\tau_i, \tau_j)\, g_a(\lVert r_{ij} \rVert)\, r_{ij}. $$

The law g of each edge type is a small network of the distance. The share s of each end is free: the
reaction to a force is the same with masses as shares, and none where the relation is one-way. Laws
are evaluated in the middle of the step, where a body gets at its present speed, so that a step is
accurate to second order, as the midpoint rule.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.graph import EncodedGraph
from contactgraph.bodies.message_passing import EdgeNetwork
from contactgraph.dynamics.local_dynamics import (
    LinearDynamics,
    LocalDynamics,
    SpringMassDamper,
    ThetaMethod,
    own_component,
)

_SOFT = 0.1
"""Factor on the first outputs of a law's network: relations start weak, and must earn more."""
_NEAREST = 0.03
"""Distance in units of `length`, below which its logarithm says little more."""
_LEAST_NOISE = 1e-4
"""Least standard deviation of a predicted velocity, in lengths a second."""
_FIRST_NOISE, _FIRST_SHARE = 0.1, 0.1
_FIRST_DAMPING = 1e-2
"""1/s"""
_PACE = 5.0
"""Scale of logarithms in their parameters, so that they learn as fast as networks."""
_GRID = np.linspace(0.02, 2.0, 100)
"""Distances in units of `length`, at which the greatest force is looked for."""
_LEAST_PEAK = 1e-9
_HALF = 0.5
"""Implicitness of the step: the midpoint rule."""


class ForceLaw(eqx.Module):
    """Acceleration along the displacement, as a share of it, by distance; a network.

    Its units are piecewise linear, because laws have corners, such as the end of their range.
    """

    network: eqx.nn.MLP

    def __init__(self, width: int, *, key: PRNGKeyArray):
        network = eqx.nn.MLP(2, "scalar", width, 2, jax.nn.relu, key=key)
        last = network.layers[-1]
        scaled = _SOFT * last.weight
        self.network = eqx.tree_at(lambda each: each.layers[-1].weight, network, scaled)

    def __call__(self, distance: Float[Array, ""]) -> Float[Array, ""]:
        """g, 1/s^2, of a distance in units of the laws' length."""
        return self.network(jnp.stack([distance - 1.0, jnp.log(distance + _NEAREST)]))


class ForceLaws(eqx.Module):
    """The law of each active edge type, and the share that each end takes by the two types."""

    types: list[ForceLaw]
    share: Float[Array, "active receivers senders"]

    def __init__(self, types: list[ForceLaw], node_types: int):
        self.types = types
        self.share = jnp.ones((len(types), node_types, node_types))

    @property
    def networks(self) -> list[EdgeNetwork]:
        """Those that make messages: none, since the laws are of the distance alone."""
        return []


class ExpectedTypes(eqx.Module):
    """The probabilities in the place of a sample: the mean force, where forces are linear in it."""

    def __call__(
        self, type_probability: Float[Array, "*T E K"], key: PRNGKeyArray | None
    ) -> Float[Array, "*T E K"]:
        """The probability of every type. No key is needed."""
        return type_probability


class RelationDynamics(LocalDynamics):
    """One linear step of every node under the force laws of its edges; see the module.

    ``length`` [m] is the unit of distances. The standard deviation of a predicted velocity is
    learned: a constant, ``log_noise``, and a share of what edges can add, ``log_share``, because
    laws are known up to a factor only.
    """

    message_passing: ForceLaws
    discretization: ThetaMethod
    gain: Float[Array, " node_types"]
    """w, 1/kg: acceleration of actuated nodes by the control."""
    log_damping: Float[Array, " node_types"]
    log_noise: Float[Array, ""]
    log_share: Float[Array, ""]
    length: float = eqx.field(static=True)
    node_types: int = eqx.field(static=True)
    width: int = eqx.field(static=True)

    def __init__(
        self, length: float, node_types: int, active_types: int, width: int, *, key: PRNGKeyArray
    ):
        keys = jax.random.split(key, active_types)
        laws = [ForceLaw(width, key=each) for each in keys]
        self.message_passing = ForceLaws(laws, node_types)
        self.discretization = ThetaMethod(_HALF, learned=False)
        self.gain = jnp.ones(node_types)
        self.log_damping = jnp.full(node_types, np.log(_FIRST_DAMPING) / _PACE)
        self.log_noise = jnp.full((), np.log(_FIRST_NOISE) / _PACE)
        self.log_share = jnp.full((), np.log(_FIRST_SHARE) / _PACE)
        self.length, self.node_types = length, node_types
        self.width = width

    def noise(self, effects: Float[Array, "*T N D Z"]) -> Float[Array, "*T N"]:
        """Standard deviation of each predicted velocity, m/s, given what edges can add to it."""
        constant = self.length * (_LEAST_NOISE + jnp.exp(_PACE * self.log_noise))
        possible = jnp.mean(jnp.sum(effects**2, axis=-1), axis=-1)
        return jnp.sqrt(constant**2 + jnp.exp(2.0 * _PACE * self.log_share) * possible)

    def accelerations(self, graph: EncodedGraph, dt: float) -> Float[Array, "2 E active D"]:
        """m/s^2 of the first and the second node of every edge, by each active type if it acts."""
        bodies = graph.bodies
        middle = bodies.position + _HALF * dt * bodies.velocity
        first, second = graph.geometry.edge_index
        displacement = middle[second] - middle[first]
        squared = jnp.sum(displacement**2, axis=-1)
        distance = jnp.sqrt(squared + (1e-3 * self.length) ** 2) / self.length
        laws = [jax.vmap(law)(distance) for law in self.message_passing.types]
        kind, share = bodies.node_type, self.message_passing.share
        of_first = jnp.einsum("ars,er,es->ea", share, kind[first], kind[second])
        of_second = jnp.einsum("ars,er,es->ea", share, kind[second], kind[first])
        nodes = bodies.nodes
        exists = nodes.candidate & nodes.mask[first] & nodes.mask[second]
        law = jnp.where(exists[:, None], jnp.stack(laws, -1), 0.0)
        toward = law[..., None] * displacement[:, None, :]
        return jnp.stack([of_first[..., None] * toward, -of_second[..., None] * toward])

    def strength(
        self, distance: Float[Array, " E"], edge_index: Int[Array, "2 E"], node_type: Array
    ) -> Float[Array, "2 E active"]:
        """Greatest acceleration of both ends at this distance or farther, by each type.

        It is a share of the greatest at any distance: 0 beyond the range of a relation.
        """
        first, second = node_type[edge_index]
        share = jnp.abs(self.message_passing.share)
        shares = [
            jnp.einsum("ars,er,es->ea", share, one, other)
            for one, other in ((first, second), (second, first))
        ]
        grid, distance = jnp.asarray(_GRID, distance.dtype), distance / self.length

        def size(law: ForceLaw) -> tuple[Array, Array]:
            on_grid = jnp.abs(jax.vmap(law)(grid) * grid)
            here = jnp.abs(jax.vmap(law)(distance) * distance)
            beyond = jnp.max(jnp.where(grid >= distance[:, None], on_grid, 0.0), axis=-1)
            return jnp.maximum(here, beyond), jnp.max(on_grid)

        sizes, peaks = zip(*map(size, self.message_passing.types), strict=True)
        peak = jnp.maximum(jnp.stack(peaks) * jnp.max(share, axis=(1, 2)), _LEAST_PEAK)
        return jnp.stack(shares) * jnp.stack(sizes, -1) / peak

    def parameters(self, graph: EncodedGraph, dt: float) -> SpringMassDamper:
        """The parameters of every node at one step of `dt` [s], each [N, D]."""
        bodies = graph.bodies
        dimension = bodies.position.shape[-1]
        acting = self.accelerations(graph, dt) * graph.active[None, :, :, None]
        total = jnp.zeros_like(bodies.position)
        total = total.at[graph.geometry.edge_index].add(jnp.sum(acting, axis=2))
        still, mobile = jnp.zeros_like(bodies.position), bodies.nodes.mobile[:, None]
        damping = bodies.node_type @ jnp.exp(_PACE * self.log_damping)
        response = jnp.repeat(
            (bodies.nodes.actuated * (bodies.node_type @ self.gain))[:, None],
            dimension,
            1,
        )
        return SpringMassDamper(
            response=own_component(response, graph.control.shape[0]),
            stiffness_rate=still,
            damping_rate=jnp.broadcast_to(damping[:, None], still.shape),
            equilibrium=still,
            equilibrium_velocity=still,
            impact_displacement=still,
            acceleration=jnp.where(mobile, total, 0.0),
        )

    def __call__(self, graph: EncodedGraph, dt: float) -> LinearDynamics:
        """The linear step of every node."""
        return self.discretization(self.parameters(graph, dt), dt)

    def evidence(
        self, graph: EncodedGraph, dt: float, after: Float[Array, "N D"]
    ) -> tuple[Float[Array, "N D E*active"], Float[Array, "N D"]]:
        """m/s: what each type of each edge adds to every velocity, and what all together added.

        The latter is the velocity ``after`` the step less that without any edge.
        """
        free = dataclasses.replace(graph, active=jnp.zeros_like(graph.active))
        alone = self(free, dt)(graph.bodies.position, graph.bodies.velocity, graph.control)[1]
        mobile = graph.bodies.nodes.mobile[:, None]
        return self._velocity_effects(graph, dt), jnp.where(mobile, after - alone, 0.0)

    def _velocity_effects(self, graph: EncodedGraph, dt: float) -> Float[Array, "N D E*active"]:
        bodies, acting = graph.bodies, self.accelerations(graph, dt)
        first, second = graph.geometry.edge_index
        _, edges, active, dimension = acting.shape
        edge = jnp.arange(edges)
        effects = jnp.zeros((len(bodies.position), edges, active, dimension), acting.dtype)
        effects = effects.at[first, edge].add(acting[0]).at[second, edge].add(acting[1])
        effects = jnp.moveaxis(effects, -1, 1).reshape(len(bodies.position), dimension, -1)
        damping = bodies.node_type @ jnp.exp(_PACE * self.log_damping)
        scale = dt / (1.0 + _HALF * dt * damping)
        return jnp.where(bodies.nodes.mobile, scale, 0.0)[:, None, None] * effects
