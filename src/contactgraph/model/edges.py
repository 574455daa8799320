"""Edges of one step: which pairs of nodes, their prior, and their weight by distance."""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import Geometry
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


def edge_nodes(edge: Int[Array, " E"], count: int) -> Int[Array, "2 E"]:
    """The nodes of edges by their ids among all pairs of `count` nodes; (0, 0) for larger ids."""
    # The second node is the root of a triangular number, up to one by rounding.
    root = jnp.sqrt(2.0 * edge.astype(jnp.float32) + 0.25) + 0.5
    second = root.astype(edge.dtype)
    second = second - (pair_count(second) > edge)
    second = second + (pair_count(second + 1) <= edge)
    nodes = jnp.stack([edge - pair_count(second), second])
    return jnp.where(edge < pair_count(count), nodes, 0)


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


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.03)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.02)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.01)
    r"""$\epsilon$."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(geometry.contact_distance)
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        spread = 1.0 - 2.0 * self.min_probability
        return self.min_probability + spread * jax.nn.sigmoid(2.0 * margin)


class SmoothCutoff(eqx.Module):
    """Weight of an edge by distance: 1 below `inner` [m], exactly 0 from `outer` [m] on.

    A node beyond the cutoff of all others changes no prediction of theirs, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1], by its closest approach in the step."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """Weight 1 at every distance: the paper's all-pairs inference."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)
