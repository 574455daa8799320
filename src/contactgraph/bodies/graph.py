"""The graph of one step: its bodies, and which pairs of them are edges."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.mass_matrix import GroupCapacity
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_count, pair_indices
from contactgraph.data.trajectory_batch import Nodes


@dataclass(frozen=True)
class EdgeType:
    """What two bodies do to each other whose edge is active.

    A type that neither pushes nor holds is no contact. `ContactLaw` leaves its force to a law that
    extends it: see ``examples/extend_edge_type.py``.
    """

    name: str
    unilateral: bool = False
    """Whether it pushes and never pulls, where bodies meet."""
    holds: bool = False
    """Whether it couples the bodies in all directions, so that they move together."""
    coupling: float = 1.0
    """Share of the relative motion that it takes at the start of training, in (0, 1]. Types that
    start at 1, rigid, stay stiff and have no spring. Raises `InvalidInputError` beyond that."""

    def __post_init__(self) -> None:
        if not 0.0 < self.coupling <= 1.0:
            raise InvalidInputError(f"coupling must lie in (0, 1], found {self.coupling}")

    @property
    def contact(self) -> bool:
        """Whether a contact sensor may report it."""
        return self.unilateral or self.holds

    @property
    def rigid(self) -> bool:
        """Whether its coupling starts at 1, and it stays stiff."""
        return self.coupling == 1.0


MOST_EDGE_TYPES = 15
"""Active ones of a model."""
TOUCH = EdgeType("touch", unilateral=True)
HOLD = EdgeType("hold", holds=True)


def usual_edge_types(count: int) -> tuple[EdgeType, ...]:
    """The active ones of ``count`` types, of which the first is *inactive*.

    Of two the other holds; of more one is a touch, and all others hold. Further holds start apart
    from each other, spread over (0, 1): types that start alike share all data evenly, and stay
    alike. Raises `InvalidInputError` for other counts than 2 to 16.
    """
    if not 2 <= count <= 1 + MOST_EDGE_TYPES:
        raise InvalidInputError(
            f"edge types must be 2 to {1 + MOST_EDGE_TYPES}: free (0), touch (1) and types that "
            f"hold, or free and hold; found {count}"
        )
    further = range(1, count - 2)
    soft = (EdgeType(f"hold {n + 1}", holds=True, coupling=1 - n / (count - 2)) for n in further)
    return (HOLD,) if count == 2 else (TOUCH, HOLD, *soft)


def first_where(active: Iterable[bool]) -> int:
    """Place among all types of the first active one that is so; 1 where none is."""
    return 1 + next((n for n, each in enumerate(active) if each), 0)


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


class Bodies(NamedTuple):
    """The bodies of a step, and how they move."""

    position: Float[Array, "N G"]
    """m"""
    velocity: Float[Array, "N G"]
    """m/s"""
    nodes: Nodes
    node_type: Float[Array, "N node_types"]
    """One-hot."""
    turns: Float[Array, " N"]
    """1 for bodies that turn, else 0."""


class EncodedGraph(eqx.Module):
    """One step's state, control and graph, before inference and, with cut edges, after it."""

    bodies: Bodies
    control: Float[Array, " U"]
    control_displacement: Float[Array, "N D"] | None
    """m; how far the control alone moves each node, together with what it holds. None: left out of
    account."""
    contact_points: Geometry
    """The places at which nodes meet, one or more an edge, the nearest of all edges first."""
    edge_id: Int[Array, " E"] | None
    """`Edges.edge_id`."""
    node_features: Float[Array, "N F"]
    edge_features: Float[Array, "2 E G"]
    weight: Float[Array, " E"]
    """Weight of every edge by the cutoff, in [0, 1]; 0 for edges that are no candidates."""
    embedding: Float[Array, "E M"]
    prior: Float[Array, "E K"]
    """Geometric prior of the edge types; `ContactDynamics.prior_belief`."""
    active: Float[Array, "E active"]
    """Weight of each edge for each active type, in [0, 1]; `weight` until edges are cut."""
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True)
    """The active types."""
    group_capacity: GroupCapacity | None = eqx.field(static=True)
    """Most nodes that are coupled, directly or through others. None: no limit."""

    @property
    def geometry(self) -> Geometry:
        """The nearest place of every edge."""
        return self.contact_points.first(len(self.weight))
