"""Who holds whom: nodes that edges join are one group."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


class Groups(eqx.Module):
    """The group of every node, and its place in the group."""

    group: Int[Array, " N"]
    """The least of the group's nodes."""
    slot: Int[Array, " N"]
    """0, 1, 2, … within a group."""

    @property
    def largest(self) -> Int[Array, ""]:
        """How many nodes the largest group has."""
        return jnp.max(self.slot) + 1


def find_groups(joins: Bool[Array, " E"], ends: Int[Array, "2 E"], count: int) -> Groups:
    """The groups of `count` nodes that the edges make which join their ends."""
    first, second = ends
    node = jnp.arange(count, dtype=ends.dtype)

    def apart(root: Int[Array, " N"]) -> Bool[Array, " E"]:
        return joins & (root[first] != root[second])

    def merge(root: Int[Array, " N"]) -> Int[Array, " N"]:
        one, other = root[first], root[second]
        high = jnp.where(apart(root), jnp.maximum(one, other), count)
        root = root.at[high].min(jnp.minimum(one, other), mode="drop")
        return root[root]

    root = jax.lax.while_loop(lambda root: jnp.any(apart(root)), merge, node)
    order = jnp.argsort(root)
    gathered = root[order]
    begins = jnp.concatenate([jnp.ones(1, bool), gathered[1:] != gathered[:-1]])
    begin = jax.lax.cummax(jnp.where(begins, node, 0))
    return Groups(root, jnp.zeros_like(node).at[order].set(node - begin))
