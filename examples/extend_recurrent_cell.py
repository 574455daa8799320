"""A recurrent cell of your own: replace the model's inference of edges by passing another module.

Usage: python examples/extend_recurrent_cell.py

An `EdgeInference` has a field `edge_types` and two methods: `embed` sees the graph of one step,
`predict` turns the last belief, an embedding and the geometric prior into the next belief.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from contactgraph.envs import PickupTask
from contactgraph.model import (
    HOLD,
    ContactBelief,
    EdgeInference,
    EdgeNetwork,
    EdgeType,
    Inference,
    ModelConfig,
    ModelState,
    ours,
    scene_nodes,
    without_change,
)


class LeakyEdges(EdgeInference):
    """A leaky integrator of the scores of the edge types, one for each edge."""

    messages: EdgeNetwork
    output: eqx.nn.Linear
    leak: jax.Array
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=(HOLD,))

    def embed(self, node, edge, weight, edge_index, **step):
        """Scores [E, K] of the edge types, from the messages along every edge."""
        _, message = self.messages(node, edge, weight, edge_index)
        return jax.vmap(self.output)(message[0] + message[1])

    def predict(self, belief, embedding, prior):
        """The next belief: a share of the last log-probabilities, plus the scores. No edge changes
        its type within a step."""
        share = jax.nn.sigmoid(self.leak)
        last = jnp.log(jnp.clip(belief.type_probability, 1e-6, 1.0))
        types = jax.nn.softmax(share * last + (1.0 - share) * embedding, axis=-1)
        return without_change(ContactBelief(types))


config = ModelConfig(2, 2, 0.05, width=16)
model = ours(config, key=jax.random.key(0), inference=Inference.RECURRENT)
keys = jax.random.split(jax.random.key(1))
messages = EdgeNetwork(model.features.edge_size(2), 16, key=keys[0])
cell = LeakyEdges(messages, eqx.nn.Linear(16, 2, key=keys[1]), jnp.zeros(()))
model = dataclasses.replace(model, inference=cell)

task = PickupTask()
observation, _ = task.reset(seed=0)
nodes = scene_nodes(task.scene)
position, velocity = jnp.asarray(observation["position"]), jnp.asarray(observation["velocity"])
state = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
states = eqx.filter_jit(model.rollout)(state, jnp.ones((3, 2)), nodes)
print("probability of contact, gripper - target, with a leaky cell:")
print(", ".join(f"{float(each):.3f}" for each in states.belief.probability[:, 0]))
