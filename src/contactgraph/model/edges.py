"""Edges of one step: all pairs of nodes, or those that a list restricts them to."""

from typing import Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.mass_matrix import MassMatrix, MassMatrixSolution
from contactgraph.data.graph import pair_count, pair_indices


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


class GroupCapacity(Protocol):
    """Most nodes that contacts couple, directly or through others; it solves group by group."""

    @property
    def nodes(self) -> int:
        """That number."""

    def solve(self, matrix: MassMatrix, vectors: Float[Array, "N d c"]) -> MassMatrixSolution:
        """As `solve_dense`; NaN where more nodes are coupled."""


class EdgeList(Protocol):
    """Restricts the edges of a step to near pairs of nodes, such as a `NeighborList`."""

    @property
    def max_edges(self) -> int:
        """Number of edges of a step, with padding."""

    @property
    def groups(self) -> GroupCapacity | None:
        """None: all nodes are solved as one group."""

    def __call__(
        self,
        position: Float[Array, "N D"],
        bound: Float[Array, " N"],
        mask: Bool[Array, " N"],
        cutoff: float,
    ) -> Edges:
        """The pairs of a step in which each node moves at most its travel ``bound`` [m].

        Nodes that stay farther apart than ``cutoff`` [m] have no edge, nor have nodes outside the
        ``mask``.
        """


def edge_count(neighbor_list: EdgeList | None, node_count: int) -> int:
    """Number of edges of a step: the list's capacity, or all pairs."""
    return pair_count(node_count) if neighbor_list is None else neighbor_list.max_edges
