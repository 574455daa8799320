"""A world with exact contacts, as a model whose edges can be forced."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from model_scenes import DT, preset

from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    HOLD,
    ContactBelief,
    ContactDynamics,
    EdgeInference,
    EdgeType,
    LinearDynamics,
    ModelState,
    WithoutContacts,
    two_type_belief,
    without_change,
)


class _NoMessages(eqx.Module):
    types: tuple = (None,)


class RigidGroups(WithoutContacts):
    """Bodies of 1 kg: those joined by active edges take their common velocity, then share forces.

    Positions move with the velocity after the step.
    """

    message_passing: _NoMessages = dataclasses.field(default_factory=_NoMessages)

    def __call__(self, graph, dt):
        (N, D), control_size = graph.bodies.position.shape, len(graph.control)
        first, second = pair_indices(N).T
        active = jnp.sum(graph.active, axis=-1) > 0.5
        group = jnp.eye(N).at[first, second].set(active).at[second, first].set(active)
        group = group.at[jnp.arange(N), jnp.arange(N)].set(1.0)
        for _ in range(N):
            group = jnp.minimum(group @ group, 1.0)
        share = group / jnp.sum(group, axis=1, keepdims=True)
        jump = share @ graph.bodies.velocity - graph.bodies.velocity
        inverse = jnp.broadcast_to((share @ graph.bodies.nodes.actuated)[:, None], (N, D))
        one, zero = jnp.ones((N, D)), jnp.zeros((N, D))
        A = jnp.stack([jnp.stack([one, dt * one], -1), jnp.stack([zero, one], -1)], -2)
        push = jnp.stack([dt**2 * inverse, dt * inverse], -1)
        B = push[..., None] * jnp.eye(D, control_size)[:, None, :]
        offset = jnp.stack([dt * jump, jump], -1)
        kind = graph.bodies.position.dtype
        return LinearDynamics(A.astype(kind), B.astype(kind), offset.astype(kind))


class Keeps(EdgeInference):
    """Believes of the coming step what it believed of the last, times a factor."""

    factor: float = 1.0
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=(HOLD,))

    def predict(self, belief: ContactBelief, embedding, prior):
        return without_change(two_type_belief(self.factor * belief.probability))


def rigid_world(factor: float = 1.0) -> ContactDynamics:
    """Contacts are observable by motion only."""
    return dataclasses.replace(
        preset("recurrent"), local_dynamics=RigidGroups(), inference=Keeps(factor)
    )


def in_a_row(count: int, velocity, probability, gap: float = 0.08) -> ModelState:
    """Bodies ``gap`` [m] apart along the first axis; ``velocity`` [N] is along it."""
    position = np.zeros((count, 2))
    position[:, 0] = gap * np.arange(count)
    speeds = np.zeros((count, 2))
    speeds[:, 0] = velocity
    edges = len(pair_indices(count))
    return ModelState(
        jnp.asarray(position),
        jnp.asarray(speeds),
        two_type_belief(jnp.full(edges, float(probability))),
    )


def observed_after(state: ModelState, velocity) -> tuple:
    """Position and velocity one step on, if bodies go on with ``velocity`` [N] along the row."""
    speeds = jnp.zeros_like(state.velocity).at[:, 0].set(jnp.asarray(velocity))
    return state.position + DT * speeds, speeds
