"""Which pairs of nodes are looked at in a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data.graph import pair_indices

_PRODUCT_NODES = 32
"""Up to so many nodes a one-hot product is faster on CPU than a scatter."""


class Edges(eqx.Module):
    """The pairs of one step: all there are, or those near enough to matter."""

    pairs: Int[Array, "E 2"]
    edge_id: Int[Array, " E"] | None
    """Place of each pair in `pair_indices`' order, ascending; the number of all pairs for padding,
    whose pair is (0, 0). None: these are all pairs, in that order."""
    fits: Bool[Array, ""]
    """False where pairs are missing, because there are more than there is room for."""

    def candidate(self, candidate: Bool[Array, " all"]) -> Bool[Array, " E"]:
        """What is given for all pairs, for these; False for padding."""
        if self.edge_id is None:
            return candidate
        return candidate.at[self.edge_id].get(mode="fill", fill_value=False)


def all_pairs(count: int) -> Edges:
    """The pairs of `count` nodes."""
    return Edges(jnp.asarray(pair_indices(count)), None, jnp.ones((), bool))


def numbered(number: Int[Array, " E"], count: int) -> Int[Array, "E 2"]:
    """The pairs of these places among all of `count` nodes; (0, 0) for places beyond."""
    # The second node is the root of a triangular number, to rounding: one step up or down at most.
    root = jnp.sqrt(2.0 * number.astype(jnp.float32) + 0.25) + 0.5
    second = root.astype(number.dtype)
    second = second - (_below(second) > number)
    second = second + (_below(second + 1) <= number)
    pairs = jnp.stack([number - _below(second), second], axis=-1)
    return jnp.where((number < pair_count(count))[:, None], pairs, 0)


def place(first: Int[Array, " E"], second: Int[Array, " E"]) -> Int[Array, " E"]:
    """The place of each pair, whichever of its nodes is the first, in `pair_indices`' order."""
    return _below(jnp.maximum(first, second)) + jnp.minimum(first, second)


def pair_count(count: int) -> int:
    """How many pairs `count` nodes make."""
    return count * (count - 1) // 2


def _below(node: Int[Array, " E"]) -> Int[Array, " E"]:
    """How many pairs there are of the nodes before this one."""
    return node * (node - 1) // 2


def sum_at_nodes(
    arriving: Float[Array, "2 E ..."], ends: Int[Array, "2 E"], count: int
) -> Float[Array, "N ..."]:
    """Sum at each of `count` nodes of what arrives at the first and second ends of the edges."""
    flat = arriving.reshape(-1, *arriving.shape[2:])
    if count > _PRODUCT_NODES:
        return jax.ops.segment_sum(flat, ends.reshape(-1), count)
    arrives = (jnp.arange(count)[:, None] == ends.reshape(-1)).astype(arriving.dtype)
    return (arrives @ flat.reshape(flat.shape[0], -1)).reshape(count, *flat.shape[1:])
