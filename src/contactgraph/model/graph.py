"""Edges of one step: their nodes, their ids, and sums at their ends."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.graph import edge_id, pair_count, pair_indices

_PRODUCT_NODES = 32
"""Up to this number of nodes a one-hot product is faster on CPU than a scatter."""


class Edges(eqx.Module):
    """The pairs of nodes that one step considers: all pairs, or only the near ones."""

    edge_index: Int[Array, "2 E"]
    """First and second node of each edge."""
    edge_id: Int[Array, " E"] | None
    """Row of each pair in `pair_indices`, ascending; padding has the number of all pairs as its id
    and (0, 0) as its nodes. None: the edges are all pairs, in that order."""
    fits: Bool[Array, ""]
    """False where pairs are missing because they exceed a capacity."""

    def select(self, of_all: Bool[Array, " all"]) -> Bool[Array, " E"]:
        """A property of all pairs, for these edges; False for padding."""
        if self.edge_id is None:
            return of_all
        return of_all.at[self.edge_id].get(mode="fill", fill_value=False)


def all_pairs(count: int) -> Edges:
    """The edges between all pairs of `count` nodes."""
    return Edges(jnp.asarray(pair_indices(count).T), None, jnp.ones((), bool))


def edge_nodes(edge: Int[Array, " E"], count: int) -> Int[Array, "2 E"]:
    """The nodes of edges by their ids among all pairs of `count` nodes; (0, 0) for larger ids."""
    # The second node is the root of a triangular number, up to one by rounding.
    root = jnp.sqrt(2.0 * edge.astype(jnp.float32) + 0.25) + 0.5
    second = root.astype(edge.dtype)
    second = second - (pair_count(second) > edge)
    second = second + (pair_count(second + 1) <= edge)
    nodes = jnp.stack([edge - pair_count(second), second])
    return jnp.where(edge < pair_count(count), nodes, 0)


def unordered_edge_id(one: Int[Array, " E"], other: Int[Array, " E"]) -> Int[Array, " E"]:
    """The id of the edge between two nodes, in either order."""
    return edge_id(jnp.minimum(one, other), jnp.maximum(one, other))


def sum_at_nodes(
    arriving: Float[Array, "2 E ..."], edge_index: Int[Array, "2 E"], count: int
) -> Float[Array, "N ..."]:
    """Sum, at each of `count` nodes, over the edges that have it as first or second node."""
    flat = arriving.reshape(-1, *arriving.shape[2:])
    if count > _PRODUCT_NODES:
        return jax.ops.segment_sum(flat, edge_index.reshape(-1), count)
    arrives = (jnp.arange(count)[:, None] == edge_index.reshape(-1)).astype(arriving.dtype)
    columns = flat.reshape(flat.shape[0], math.prod(flat.shape[1:]))
    return (arrives @ columns).reshape(count, *flat.shape[1:])
