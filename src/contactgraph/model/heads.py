"""Heads: from messages on active edges to spring-mass-damper parameters of every node."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.model.shapes import hinge_constraint
from contactgraph.model.types import EncodedGraph, Nodes, SpringMassDamper, own_component

_MIN_SHARE = 1e-6


def coupling_starts(active_types: int) -> np.ndarray:
    """[active] logits at which the couplings of the types start.

    A touch and the first type that holds start rigid, further ones apart from each other, spread
    over (0, 1): types that start alike share all data evenly, and stay alike.
    """
    further = np.arange(1, active_types - 1)
    return np.append(np.full(min(active_types, 2), 5.0), np.log((active_types - 1) / further - 1.0))


def with_hinge_springs(
    parameters: SpringMassDamper,
    graph: EncodedGraph,
    coupling: Float[Array, " E"],
    change: Float[Array, "N D"],
    *,
    theta: Array,
    dt: float,
) -> SpringMassDamper:
    """The parameters with the springs that keep bodies turning about their hinges; ``change`` [m/s]
    is that of their velocities by contacts."""
    anchor = graph.nodes.anchor
    assert anchor is not None and parameters.acceleration is not None
    constraint = hinge_constraint(
        anchor,
        graph.position,
        graph.velocity + change,
        coupling,
        graph.geometry.edge_index,
        graph.geometry.relative_velocity,
    )
    own = parameters.stiffness_rate
    before = 1.0 + theta * (dt * parameters.damping_rate) + theta**2 * dt**2 * own
    stiffness = constraint.stiffness_rate[:, None] * before  # as stiff whatever the damper does
    after = before + theta**2 * dt**2 * stiffness
    sprung = dataclasses.replace(
        parameters,
        response=parameters.response * (after / before)[..., None],
        stiffness_rate=stiffness + own,
        equilibrium=(stiffness * constraint.center + own * parameters.equilibrium)
        / jnp.maximum(stiffness + own, _MIN_SHARE),
        acceleration=(acceleration := parameters.acceleration * (after / before)),
    )
    moved = graph.position + theta * dt * graph.velocity
    pull = dt * (acceleration - stiffness * (moved - constraint.center))
    # The position after the step without control; see `ThetaMethod`.
    displacement = sprung.impact_displacement
    position = graph.position + dt * (graph.velocity + theta * pull / after) + displacement
    return dataclasses.replace(
        sprung, impact_displacement=displacement + constraint.projection(position)
    )


class WithoutContacts(eqx.Module):
    """What local dynamics, or their heads, answer that know of no contact within a step."""

    def coasting(
        self,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        node_type: Float[Array, "N types"],
        nodes: Nodes,
        turns: Float[Array, " N"],
        dt: float,
    ) -> Float[Array, "N G"]:
        """Velocity of every node, m/s, after a step of ``dt`` [s] in which nothing acts on it."""
        return velocity

    def control_displacement(self, *given: object, **step: object) -> None:
        """See `ContactLaw.control_displacement`; None: it is left out of account."""

    def retract(
        self,
        graph: EncodedGraph,
        position: Float[Array, "N G"],
        velocity: Float[Array, "N G"],
        *,
        dt: float,
        theta: Array | None = None,
    ) -> tuple[Float[Array, "N G"], Float[Array, "N G"]]:
        """See `ContactLaw.retract`: as they are."""
        return position, velocity


class PerDegreeHead(WithoutContacts):
    """The paper's head: free 1/m, k, c and equilibrium of every node and degree of freedom.

    The equilibrium is relative to the node's hinge, or, where it has none, to its own position.
    Parameters are positive.
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
        graph: EncodedGraph,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        *,
        theta: Array,
        dt: float,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        out = jax.vmap(self.node)(embedding).reshape(-1, 4, self.dimension)
        origin, anchor = graph.position, graph.nodes.anchor
        if anchor is not None:
            origin = jnp.where(jnp.isfinite(anchor), anchor, origin)
        return SpringMassDamper(
            response=own_component(5.0 * jax.nn.sigmoid(out[:, 0]), graph.control.shape[0]),
            stiffness_rate=5.0 * jax.nn.sigmoid(out[:, 1]),
            damping_rate=5.0 * jax.nn.sigmoid(out[:, 2]),
            equilibrium=origin + out[:, 3],
            equilibrium_velocity=jnp.zeros_like(origin),
            impact_displacement=jnp.zeros_like(origin),
        )
