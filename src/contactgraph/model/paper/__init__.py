"""The paper's model in its order: features, prior, graph inference, and forward dynamics."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.graph import HOLD, EdgeType, EncodedGraph
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing, TypedMessagePassing
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.local_dynamics import (
    LinearDynamics,
    LocalDynamics,
    SpringMassDamper,
    WithoutContacts,
    own_component,
)
from contactgraph.inference.contact_belief import ContactBelief, without_change
from contactgraph.inference.edge_inference import EdgeInference
from contactgraph.inference.features import Features


class AbsoluteFeatures(Features):
    """The paper's features: position, velocity and type of a node; distance of an edge."""

    contact_distance: float = eqx.field(static=True, default=0.1)
    """m, centre to centre; these features do not use it."""
    hinges: bool = eqx.field(static=True, default=False)
    """Whether nodes may be hinged; the radius vector from the hinge is a feature then."""

    @property
    def node_types(self) -> int:
        """Number of node types."""
        return 4 if self.hinges else 2

    def node_type(self, nodes: Nodes, dtype: DTypeLike) -> Float[Array, "N node_types"]:
        """One-hot: actuated or not; times hinged or not, where there are hinges."""
        index = nodes.actuated.astype(int)
        if self.hinges:
            index = index + 2 * nodes.hinged.astype(int)
        return jax.nn.one_hot(index, self.node_types, dtype=dtype)

    def node_size(self, dimension: int) -> int:
        """Number of features a node."""
        return 2 * dimension + self.node_types + self.hinges * dimension

    def edge_size(self, dimension: int) -> int:
        """Number of features an edge."""
        return 1

    def node(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> Float[Array, "N F"]:
        """Features of every node."""
        features = [position, velocity, self.node_type(nodes, position.dtype)]
        if self.hinges and nodes.anchor is not None:
            hinged = nodes.hinged[:, None]
            features.append(jnp.where(hinged, position - jnp.nan_to_num(nodes.anchor), 0.0))
        elif self.hinges:
            features.append(jnp.zeros_like(position))
        return jnp.concatenate(features, axis=-1)

    def edge(self, geometry: Geometry) -> Float[Array, "2 E F"]:
        """Features of every edge, for the messages to its first and to its second node."""
        features = geometry.distance[:, None]
        return jnp.stack([features, features])


class DistancePrior(eqx.Module):
    r"""The paper's prior: probability of contact from the present distance $d$ of two nodes.

    $$ q = \sigma\big( 2 (d_{th} - d) / s \big), \qquad
       s = s_\text{inside}\ (d < d_{th}),\ s_\text{outside}\ (d \ge d_{th}) $$

    With both scales 1 m it is the paper's text; its authors' prior is ten times as sharp inside.
    """

    threshold: float = eqx.field(static=True, default=0.1)
    """$d_{th}$, m."""
    inside: float = eqx.field(static=True, default=0.1)
    """Scale below the threshold, m."""
    outside: float = eqx.field(static=True, default=1.0)
    """Scale above the threshold, m."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        margin = self.threshold - geometry.distance
        scale = jnp.where(margin > 0, self.inside, self.outside)
        return jax.nn.sigmoid(2.0 * margin / scale)


class _MessageEdges(EdgeInference):
    """Edges by messages in space; what follows from these differs."""

    message_passing: MessagePassing | EdgeNetwork
    output: eqx.nn.Linear
    """Of the sum of an edge's two messages."""
    edge_types: tuple[EdgeType, ...] = eqx.field(static=True)

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those whose messages decide about edges."""
        return [self.message_passing]

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
        **step: Any,
    ) -> Float[Array, "E M"]:
        """Input of the recurrent cell, or scores of the types, of every edge of a step's graph."""
        _, message = self.message_passing(node, edge, weight, edge_index)
        # Contact is symmetric: the two directions are summed before anything is decided.
        return jax.vmap(self.output)(message[0] + message[1])


class RecurrentEdges(_MessageEdges):
    """Messages in space, then one gated recurrent cell per edge in time (the paper's GIM-Temp).

    The belief itself is the recurrent state, so a corrected belief changes later predictions.
    """

    hidden: eqx.nn.Linear
    temperature: float = eqx.field(static=True)

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: tuple[EdgeType, ...] = (HOLD,),
        temperature: float = 0.15,
        key: PRNGKeyArray,
    ):
        """`temperature` divides the cell's state before the softmax; at 1 no edge is certain."""
        keys = jax.random.split(key)
        self.message_passing = message_passing
        count = 1 + len(edge_types)
        self.output = eqx.nn.Linear(message_passing.width, 3 * count, key=keys[0])
        self.hidden = eqx.nn.Linear(count, 3 * count, key=keys[1])
        self.edge_types = edge_types
        self.temperature = temperature

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step."""
        state = belief.type_probability
        reset_in, update_in, new_in = jnp.split(embedding, 3, axis=-1)
        mixed = jax.vmap(self.hidden)(state)
        reset_mixed, update_mixed, new_mixed = jnp.split(mixed, 3, axis=-1)
        reset = jax.nn.sigmoid(reset_in + reset_mixed)
        update = jax.nn.sigmoid(update_in + update_mixed)
        new = jnp.tanh(new_in + reset * new_mixed)
        state = (1.0 - update) * new + update * state
        return without_change(ContactBelief(jax.nn.softmax(state / self.temperature, axis=-1)))


class MemorylessEdges(_MessageEdges):
    """Messages in space only, without memory (the paper's GIM-Non-Temp)."""

    def __init__(
        self,
        message_passing: MessagePassing | EdgeNetwork,
        *,
        edge_types: tuple[EdgeType, ...] = (HOLD,),
        key: PRNGKeyArray,
    ):
        self.message_passing = message_passing
        self.output = eqx.nn.Linear(message_passing.width, 1 + len(edge_types), key=key)
        self.edge_types = edge_types

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E K"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step, independent of the old one."""
        return without_change(ContactBelief(jax.nn.softmax(embedding, axis=-1)))


class PerDegreeHead(WithoutContacts):
    """The paper's head: free 1/m, k, c and equilibrium of every node and degree of freedom.

    The equilibrium is relative to the node's hinge, or, where it has none, to its own position.
    Parameters are positive.
    """

    node: eqx.nn.MLP
    width: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, width: int, dimension: int, *, key: PRNGKeyArray):
        self.node = eqx.nn.MLP(width, 4 * dimension, width, 2, key=key)
        self.width = width
        self.dimension = dimension

    def __call__(
        self,
        graph: EncodedGraph,
        embedding: Float[Array, "N W"],
        message: Float[Array, "active 2 E W"],
        *,
        theta: Array,
        dt: float,
    ) -> SpringMassDamper:
        """Parameters of every node at one step."""
        out = jax.vmap(self.node)(embedding).reshape(-1, 4, self.dimension)
        origin, anchor = graph.bodies.position, graph.bodies.nodes.anchor
        if anchor is not None:
            origin = jnp.where(jnp.isfinite(anchor), anchor, origin)
        return SpringMassDamper(
            response=own_component(5.0 * jax.nn.sigmoid(out[:, 0]), graph.control.shape[0]),
            stiffness_rate=5.0 * jax.nn.sigmoid(out[:, 1]),
            damping_rate=5.0 * jax.nn.sigmoid(out[:, 2]),
            equilibrium=origin + out[:, 3],
            equilibrium_velocity=jnp.zeros_like(origin),
            impact_displacement=jnp.zeros_like(origin),
            acceleration=jnp.zeros_like(origin),
        )


class FreeLinearDynamics(LocalDynamics):
    """Messages over the active edges, then free matrices for every node (the paper's Full-AB).

    Nothing keeps these stable; they serve as a comparison.
    """

    message_passing: TypedMessagePassing
    head: eqx.nn.MLP
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)

    def __init__(
        self,
        message_passing: TypedMessagePassing,
        *,
        dimension: int,
        control_size: int,
        key: PRNGKeyArray,
    ):
        width = message_passing.width
        self.message_passing = message_passing
        self.head = eqx.nn.MLP(width, dimension * (6 + 2 * control_size), width, 2, key=key)
        self.dimension = dimension
        self.control_size = control_size
        self.axis_aligned = False

    def __call__(self, graph: EncodedGraph, dt: float) -> LinearDynamics:
        """The linear step of every node: the identity plus the network's output times dt."""
        embedding, _ = self.message_passing(
            graph.node_features, graph.edge_features, graph.active, graph.geometry.edge_index
        )
        out = jax.vmap(self.head)(embedding)
        out = out.reshape(-1, self.dimension, 2, 3 + self.control_size)
        A = jnp.eye(2, dtype=out.dtype) + dt * out[..., :2]
        return LinearDynamics(A=A, B=dt * out[..., 3:], offset=dt * out[..., 2])
