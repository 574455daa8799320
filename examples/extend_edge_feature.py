"""A feature of your own on every edge: extend the features and make the networks that wide.

Usage: python examples/extend_edge_feature.py

Features tell their sizes, so that networks are built to fit. This one adds the relative speed of
the two bodies along the line between them, bounded to (-1, 1).
"""

import dataclasses

import jax
import jax.numpy as jnp

from contactgraph.model import (
    EdgeNetwork,
    Inference,
    InvariantFeatures,
    ModelConfig,
    ModelState,
    Nodes,
    RecurrentEdges,
    TypedMessagePassing,
    ours,
)


class WithApproach(InvariantFeatures):
    """Invariant features, and the speed of approach of every edge."""

    def edge_size(self, dimension):
        """Number of features per edge."""
        return super().edge_size(dimension) + 1

    def edge(self, geometry):
        """Features [2, E, F] of every edge, for the messages to its first and second node."""
        features = super().edge(geometry)
        approach = -jnp.sum(geometry.relative_velocity * geometry.direction, axis=-1)
        bounded = approach / (self.speed + jnp.abs(approach))
        return jnp.concatenate([features, jnp.stack([bounded, bounded])[..., None]], axis=-1)


config = ModelConfig(2, 2, 0.05, width=16)
model = ours(config, key=jax.random.key(0), inference=Inference.RECURRENT)
features = WithApproach(length=0.085)
inference_key, dynamics_key, cell_key = jax.random.split(jax.random.key(1), 3)
size = features.edge_size(2)
passing = TypedMessagePassing([EdgeNetwork(size, 16, key=dynamics_key)])
model = dataclasses.replace(
    model,
    features=features,
    inference=RecurrentEdges(EdgeNetwork(size, 16, key=inference_key), key=cell_key),
    local_dynamics=dataclasses.replace(model.local_dynamics, message_passing=passing),
)

nodes = Nodes(jnp.array([True, False]), jnp.ones(2, bool), jnp.ones(1, bool))
position = jnp.array([[0.0, 0.0], [0.12, 0.0]])
for speed in (-1.0, 1.0):
    velocity = jnp.array([[speed, 0.0], [0.0, 0.0]])
    state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
    graph = model.encode_state(state, jnp.zeros(2), nodes)
    print(f"approach at {speed:+.0f} m/s: feature {float(graph.edge_features[0, 0, -1]):+.2f}")
