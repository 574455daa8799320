"""The whole model: inference of the edges, and local dynamics given the edges."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.belief import ContactBelief
from contactgraph.model.edges import Edges, all_pairs, pair_count
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.geometry import Geometry, geometry
from contactgraph.model.inference import AllEdges, MemorylessEdges, RecurrentEdges
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.local_dynamics import FreeLinearDynamics, SpringMassDamperDynamics
from contactgraph.model.local_input import LocalInput
from contactgraph.model.neighbours import NeighbourLists, edge_count, longest_ways
from contactgraph.model.prior import DistancePrior, TouchPrior
from contactgraph.model.push import advance, following, held_response
from contactgraph.model.reach import Everywhere, Reach
from contactgraph.model.sampling import ArgmaxSample, GumbelSample
from contactgraph.model.spring_mass_damper import SpringMassDamper
from contactgraph.model.state import ModelState, Nodes

_MANY_EDGES = 500
"""A scene is large that has more."""


class Percept(eqx.Module):
    """One step's graph as the model sees it, before anything is inferred."""

    geometry: Geometry
    number: Int[Array, " E"] | None
    """Which pairs these edges are: `Edges.number`."""
    node_features: Float[Array, "N F"]
    edge_features: Float[Array, "2 E G"]
    weight: Float[Array, " E"]
    """Reach of every edge in [0, 1]; 0 for edges that are no candidates."""
    embedding: Float[Array, "E M"]


class ContactDynamics(eqx.Module):
    """Predicts which edges are active and how the nodes move, one step at a time.

    Every function here takes one scene at one step; `jax.vmap` makes batches. Raises
    `InvalidInputError` where the number of edge types and of networks for them disagree.
    """

    inference: RecurrentEdges | MemorylessEdges | AllEdges
    local_dynamics: SpringMassDamperDynamics | FreeLinearDynamics
    features: InvariantFeatures | AbsoluteFeatures
    prior: DistancePrior | TouchPrior
    reach: Reach | Everywhere
    sample: ArgmaxSample | GumbelSample
    dt: float = eqx.field(static=True)
    """s"""
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)
    neighbours: NeighbourLists | None = None
    """How near pairs are found; None: every pair is an edge, near or far."""

    def __check_init__(self) -> None:
        if not self.dt > 0:
            raise InvalidInputError(f"dt must be a positive number of seconds, found {self.dt}")
        active_types = self.inference.edge_types - 1
        networks = len(self.local_dynamics.message_passing.types)
        if active_types < 1 or networks != active_types:
            raise InvalidInputError(
                f"local_dynamics must have one message network for each of the {active_types} "
                f"active edge types (edge_types less the inactive one), found {networks}"
            )
        if self.neighbours is not None and not isinstance(self.reach, Reach):
            raise InvalidInputError(
                "neighbours: lists of near pairs need a Reach, beyond which no edge is active; "
                f"found {type(self.reach).__name__}"
            )

    def perceive(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        push: Float[Array, "N D"] | None = None,
        touch_distance: Float[Array, " E"] | None = None,
    ) -> Percept:
        """What does not depend on the belief: geometry, features and edge embeddings.

        ``touch_distance`` [m]: at which the ends of each edge touch; None: as the model knows it.
        """
        edges = self._edges(position, velocity, nodes, push)
        if edges.number is not None:
            # What outgrows a list has no prediction, for anybody.
            velocity = jnp.where(edges.fits, velocity, jnp.nan)
        touch = self.features.touch_distance if touch_distance is None else touch_distance
        seen = geometry(position, velocity, edges.pairs, self.dt, touch, push, nodes.anchor)
        node_features = self.features.node(position, velocity, nodes)
        edge_features = self.features.edge(seen, touch_distance)
        exists = edges.candidate(nodes.candidate) & nodes.mask[seen.first] & nodes.mask[seen.second]
        weight = jnp.where(exists, self.reach(seen), 0.0)
        ends = jnp.stack([seen.first, seen.second])
        embedding = self.inference.embed(node_features, edge_features, weight, ends)
        return Percept(seen, edges.number, node_features, edge_features, weight, embedding)

    def _edges(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        push: Float[Array, "N D"] | None,
    ) -> Edges:
        if self.neighbours is None:
            return all_pairs(position.shape[0])
        assert isinstance(self.reach, Reach)
        way = longest_ways(position, velocity, push, nodes.anchor, self.dt)
        return self.neighbours(position, way, nodes.mask, self.reach.far)

    def prior_belief(self, percept: Percept) -> ContactBelief:
        """What distance alone says, the active part spread evenly over the active types."""
        active = self.prior(percept.geometry, self.features.touch_distance) * percept.weight
        active_types = self.inference.edge_types - 1
        spread = jnp.repeat(active[:, None] / active_types, active_types, axis=-1)
        types = jnp.concatenate([1.0 - active[:, None], spread], axis=-1)
        return ContactBelief(types, percept.number)

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before anything was seen: the distance prior."""
        return self.prior_belief(self.perceive(position, velocity, nodes))

    def predict_belief(self, belief: ContactBelief, percept: Percept) -> ContactBelief:
        """The belief about the coming step. An edge out of reach is inactive, surely."""
        count = pair_count(percept.node_features.shape[0])
        before = belief.over(percept.number, count)
        free = self.inference.predict(before, percept.embedding)
        active = free.type_probability[:, 1:] * percept.weight[:, None]
        inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
        return ContactBelief(jnp.concatenate([inactive, active], axis=-1), percept.number)

    def local_input(
        self,
        percept: Percept,
        belief: ContactBelief,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        key: PRNGKeyArray | None = None,
    ) -> LocalInput:
        """Cut the inactive edges from the graph."""
        edge_active = self.sample(belief.type_probability, key)
        return LocalInput(
            position=position,
            velocity=velocity,
            kind=self.features.kind(nodes, position.dtype),
            actuated=nodes.actuated.astype(position.dtype),
            node_features=percept.node_features,
            edge_features=percept.edge_features,
            weight=edge_active[:, 1:] * percept.weight[:, None],
            geometry=percept.geometry,
            anchor=nodes.anchor,
            room=None if self.neighbours is None else self.neighbours.group,
        )

    def linear_step(self, state: ModelState, nodes: Nodes) -> tuple[LinearDynamics, ContactBelief]:
        """The linear dynamics of the coming step, and the belief they rest on.

        Neither depends on the control but through ``state.push``, where that is known.
        """
        percept = self.perceive(state.position, state.velocity, nodes, state.push)
        belief = self.predict_belief(state.belief, percept)
        local = self.local_input(percept, belief, state.position, state.velocity, nodes)
        return self.local_dynamics(local, self.dt, self.control_size), belief

    def step(self, state: ModelState, control: Float[Array, " U"], nodes: Nodes) -> ModelState:
        """The next state under a control [N]."""
        return advance(self, state, held_response(self, state, nodes), control, nodes)[0]

    def rollout(self, state: ModelState, controls: Float[Array, "H U"], nodes: Nodes) -> ModelState:
        """All states that follow, ``[H, …]``; belief h is about the step that led to state h."""
        first = dataclasses.replace(state, push=None)
        # Of large scenes gradients compute anew what they need: it would fill the memory.
        large = edge_count(self.neighbours, nodes.mask.shape[0]) > _MANY_EDGES
        return following(self, first, controls, nodes, jax.checkpoint if large else None)

    def parameters(self, state: ModelState, nodes: Nodes) -> SpringMassDamper:
        """The spring-mass-damper parameters of the coming step, each [N, D].

        Raises `TypeError` where the local dynamics have no such parameters.
        """
        if not isinstance(self.local_dynamics, SpringMassDamperDynamics):
            raise TypeError(f"{type(self.local_dynamics).__name__} has no spring-mass-damper")
        percept = self.perceive(state.position, state.velocity, nodes)
        belief = self.predict_belief(state.belief, percept)
        local = self.local_input(percept, belief, state.position, state.velocity, nodes)
        return self.local_dynamics.parameters(local, self.dt, self.control_size)
