"""Friction along an edge: extend the law that makes the parameters of every node.

Usage: python examples/extend_edge_friction.py

A law takes the cut graph and its messages, and returns a spring-mass-damper of every node. This
one adds a viscous force against sliding: across an active edge, along its tangent.
"""

import dataclasses

import jax
import jax.numpy as jnp

from contactgraph.model import (
    ContactLaw,
    Inference,
    ModelConfig,
    ModelState,
    Nodes,
    SpringMassDamper,
    ours,
    sum_at_nodes,
    two_type_belief,
)


class RubbingLaw(ContactLaw):
    """A law of contact with viscous friction between bodies that slide on each other."""

    coefficient: jax.Array
    """1/s: force per mass for each m/s of sliding."""

    def __init__(self, law: ContactLaw, coefficient: float):
        """The same as a law, with friction."""
        vars(self).update(vars(law))
        self.coefficient = jnp.asarray(coefficient)

    def __call__(self, graph, embedding, message, *, theta, dt) -> SpringMassDamper:
        """Parameters of every node at one step."""
        parameters = super().__call__(graph, embedding, message, theta=theta, dt=dt)
        geometry, active = graph.geometry, jnp.sum(graph.active, axis=-1)
        normal = jnp.sum(geometry.relative_velocity * geometry.direction, axis=-1, keepdims=True)
        sliding = geometry.relative_velocity - normal * geometry.direction
        force = self.coefficient * active[:, None] * sliding
        friction = sum_at_nodes(
            jnp.stack([force, -force]), geometry.edge_index, len(graph.bodies.position)
        )
        return dataclasses.replace(parameters, acceleration=parameters.acceleration + friction)


config = ModelConfig(2, 2, 0.05, width=16)
model = ours(config, key=jax.random.key(0), inference=Inference.RECURRENT)
plain = model.local_dynamics
position, velocity = jnp.array([[0.0, 0.0], [0.08, 0.0]]), jnp.array([[0.0, 1.0], [0.0, -1.0]])
nodes = Nodes(jnp.zeros(2, bool), jnp.ones(2, bool), jnp.ones(1, bool))
for coefficient in (0.0, 5.0):
    head = RubbingLaw(plain.head, coefficient)
    rubbing = dataclasses.replace(model, local_dynamics=dataclasses.replace(plain, head=head))
    state = ModelState(position, velocity, two_type_belief(jnp.ones(1)))
    graph = rubbing.encode_state(state, jnp.zeros(2), nodes)
    graph = dataclasses.replace(graph, active=jnp.full((1, 1), 0.3))  # a weak contact
    linear = rubbing.linearize(graph)
    _, after = linear(position, velocity, jnp.zeros(2))
    print(
        f"coefficient {coefficient:.0f} 1/s: sliding at {float(after[0, 1] - after[1, 1]):.3f} m/s"
    )
print("friction slows the sliding")
