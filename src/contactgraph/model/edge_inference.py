"""Inference of active edges, in three interchangeable forms.

Each has ``embed`` (one step's graph to edge embeddings, independent of time) and ``predict``
(belief about the last step and an embedding to the belief about the next one). The split keeps the
expensive part out of the loop over time. Another recurrent cell is another class with these two
methods and a field ``edge_types``: see ``examples/extend_recurrent_cell.py``.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.model.contact_belief import ContactBelief
from contactgraph.model.message_passing import EdgeNetwork, MessagePassing


class RecurrentEdges(eqx.Module):
    """Messages in space, then one gated recurrent cell per edge in time (the paper's GIM-Temp).

    The belief itself is the recurrent state, so a corrected belief changes later predictions.
    """

    message_passing: MessagePassing | EdgeNetwork
    input: eqx.nn.Linear
    hidden: eqx.nn.Linear
    edge_types: int = eqx.field(static=True)
    temperature: float = eqx.field(static=True)

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: int = 2,
        temperature: float = 0.15,
        key: PRNGKeyArray,
    ):
        """`temperature` divides the cell's state before the softmax; at 1 no edge is certain."""
        keys = jax.random.split(key)
        self.message_passing = message_passing
        self.input = eqx.nn.Linear(message_passing.width, 3 * edge_types, key=keys[0])
        self.hidden = eqx.nn.Linear(edge_types, 3 * edge_types, key=keys[1])
        self.edge_types = edge_types
        self.temperature = temperature

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E M"]:
        """Input of the recurrent cell, for every edge of one step's graph."""
        return _edge_embedding(self.message_passing, self.input, node, edge, weight, edge_index)

    def predict(self, belief: ContactBelief, embedding: Float[Array, "E M"]) -> ContactBelief:
        """The belief about the next step."""
        state = belief.type_probability
        reset_in, update_in, new_in = jnp.split(embedding, 3, axis=-1)
        mixed = jax.vmap(self.hidden)(state)
        reset_mixed, update_mixed, new_mixed = jnp.split(mixed, 3, axis=-1)
        reset = jax.nn.sigmoid(reset_in + reset_mixed)
        update = jax.nn.sigmoid(update_in + update_mixed)
        new = jnp.tanh(new_in + reset * new_mixed)
        state = (1.0 - update) * new + update * state
        return ContactBelief(jax.nn.softmax(state / self.temperature, axis=-1))


class MemorylessEdges(eqx.Module):
    """Messages in space only, without memory (the paper's GIM-Non-Temp)."""

    message_passing: MessagePassing | EdgeNetwork
    output: eqx.nn.Linear
    edge_types: int = eqx.field(static=True)

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: int = 2,
        key: PRNGKeyArray,
    ):
        self.message_passing = message_passing
        self.output = eqx.nn.Linear(message_passing.width, edge_types, key=key)
        self.edge_types = edge_types

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E K"]:
        """Scores of the edge types, for every edge of one step's graph."""
        return _edge_embedding(self.message_passing, self.output, node, edge, weight, edge_index)

    def predict(self, belief: ContactBelief, embedding: Float[Array, "E K"]) -> ContactBelief:
        """The belief about the next step, independent of the old one."""
        return ContactBelief(jax.nn.softmax(embedding, axis=-1))


class AllEdges(eqx.Module):
    """Every edge active at every step (the paper's No-GIM)."""

    edge_types: int = eqx.field(static=True, default=2)

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E 0"]:
        """Nothing to embed."""
        return jnp.zeros((weight.shape[0], 0), node.dtype)

    def predict(self, belief: ContactBelief, embedding: Float[Array, "E 0"]) -> ContactBelief:
        """Certainty that every edge is active (of the first active type)."""
        certain = jnp.zeros_like(belief.type_probability).at[..., 1].set(1.0)
        return ContactBelief(certain)


def _edge_embedding(
    message_passing: MessagePassing | EdgeNetwork,
    output: eqx.nn.Linear,
    node: Float[Array, "N F"],
    edge: Float[Array, "2 E G"],
    weight: Float[Array, " E"],
    edge_index: Int[Array, "2 E"],
) -> Float[Array, "E out"]:
    _, message = message_passing(node, edge, weight, edge_index)
    # Contact is symmetric: the two directions are summed before anything is decided.
    return jax.vmap(output)(message[0] + message[1])
