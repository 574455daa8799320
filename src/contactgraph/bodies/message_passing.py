"""Rounds of messages along weighted edges."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.geometry import sum_at_nodes


class _Round(eqx.Module):
    """One round: a message in both directions of every edge, then an update of every node.

    The message network's first layer is factored (receiver, sender, edge), so that the nodes' part
    is computed once per node and not once per edge.
    """

    receiver: eqx.nn.Linear
    sender: eqx.nn.Linear
    edge: eqx.nn.Linear
    message: eqx.nn.Linear
    update: eqx.nn.MLP

    def __init__(self, node_size: int, edge_size: int, width: int, key: PRNGKeyArray):
        keys = jax.random.split(key, 5)
        self.receiver = eqx.nn.Linear(node_size, width, key=keys[0])
        self.sender = eqx.nn.Linear(node_size, width, use_bias=False, key=keys[1])
        self.edge = eqx.nn.Linear(edge_size, width, use_bias=False, key=keys[2])
        self.message = eqx.nn.Linear(width, width, key=keys[3])
        self.update = eqx.nn.MLP(node_size + width, width, width, 1, key=keys[4])

    def __call__(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> tuple[Float[Array, "N W"], Float[Array, "2 E W"]]:
        received, sent = jax.vmap(self.receiver)(node), jax.vmap(self.sender)(node)
        hidden = jax.nn.relu(
            received[edge_index] + sent[edge_index[::-1]] + _along_edges(self.edge, edge)
        )
        message = jax.nn.relu(_along_edges(self.message, hidden)) * weight[:, None]
        total = sum_at_nodes(message, edge_index, node.shape[0])
        return jax.vmap(self.update)(jnp.concatenate([node, total], axis=-1)), message


def _along_edges(layer: eqx.nn.Linear, values: Float[Array, "2 E F"]) -> Float[Array, "2 E W"]:
    return jax.vmap(jax.vmap(layer))(values)


class MessagePassing(eqx.Module):
    """`rounds` rounds of weighted messages, so that an edge of weight 0 has no effect.

    Returns node embeddings ``[N, width]`` and the last round's messages ``[2, E, width]``, to the
    first and to the second node of every edge.
    """

    steps: list[_Round]
    width: int = eqx.field(static=True)

    def __init__(
        self, node_size: int, edge_size: int, width: int = 32, rounds: int = 2, *, key: PRNGKeyArray
    ):
        sizes = [node_size] + [width] * (rounds - 1)
        keys = jax.random.split(key, rounds)
        self.steps = [
            _Round(size, edge_size, width, key) for size, key in zip(sizes, keys, strict=True)
        ]
        self.width = width

    def __call__(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> tuple[Float[Array, "N W"], Float[Array, "2 E W"]]:
        """Pass messages; edge e joins the nodes ``edge_index[0, e]`` and ``edge_index[1, e]``."""
        embedding, message = self.steps[0](node, edge, weight, edge_index)
        for step in self.steps[1:]:
            update, message = step(embedding, edge, weight, edge_index)
            embedding = embedding + update
        return embedding, message


class EdgeNetwork(eqx.Module):
    """Messages from each edge's own features alone, the same in both directions.

    Contact depends on the pair's own features only, not on node types or other nodes near, so what
    was learned from one pair holds for any other, however many there are. Returns as
    `MessagePassing` does, with empty node embeddings.
    """

    rounds = 0
    """No message depends on another."""
    network: eqx.nn.MLP
    width: int = eqx.field(static=True)

    def __init__(self, edge_size: int, width: int = 32, *, key: PRNGKeyArray):
        self.network = eqx.nn.MLP(edge_size, width, width, 2, final_activation=jax.nn.relu, key=key)
        self.width = width

    def __call__(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> tuple[Float[Array, "N 0"], Float[Array, "2 E W"]]:
        """One weighted message per edge."""
        message = jax.vmap(self.network)(0.5 * (edge[0] + edge[1])) * weight[:, None]
        return jnp.zeros((node.shape[0], 0), node.dtype), jnp.stack([message, message])


class TypedMessagePassing(eqx.Module):
    """Message passing with separate networks for every active edge type.

    Returns node embeddings summed over the types, ``[N, width]``, and every type's last messages,
    ``[K-1, 2, E, width]``.
    """

    types: list[MessagePassing | EdgeNetwork]

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those that make the messages."""
        return self.types

    @property
    def width(self) -> int:
        """Size of an embedding."""
        return self.types[0].width

    def __call__(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, "E active"],
        edge_index: Int[Array, "2 E"],
    ) -> tuple[Float[Array, "N W"], Float[Array, "active 2 E W"]]:
        """Pass messages along the edges, weighted for each active type."""
        results = [
            passing(node, edge, weight[:, index], edge_index)
            for index, passing in enumerate(self.types)
        ]
        embedding = jnp.sum(jnp.stack([node for node, _ in results]), axis=0)
        return embedding, jnp.stack([message for _, message in results])
