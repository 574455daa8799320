"""The whole model: inference of the edges, and local dynamics given the edges."""

import dataclasses
from collections.abc import Callable
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from contactgraph.data.errors import InvalidInputError
from contactgraph.model.collision import Geometry, geometry
from contactgraph.model.contact_belief import (
    ArgmaxSample,
    ClosestApproachPrior,
    ContactBelief,
    DistancePrior,
    GumbelSample,
    NoCutoff,
    SmoothCutoff,
)
from contactgraph.model.edge_inference import AllEdges, MemorylessEdges, RecurrentEdges
from contactgraph.model.features import AbsoluteFeatures, InvariantFeatures
from contactgraph.model.graph import Edges, all_pairs, pair_count
from contactgraph.model.local_dynamics import FreeLinearDynamics, SpringMassDamperDynamics
from contactgraph.model.neighbor_list import NeighborList, edge_count, travel_bound
from contactgraph.model.types import LinearDynamics, LocalInput, ModelState, Nodes, SpringMassDamper

_MANY_EDGES = 500
"""A scene is large that has more."""


class EncodedGraph(eqx.Module):
    """One step's graph as the model sees it, before anything is inferred."""

    geometry: Geometry
    edge_id: Int[Array, " E"] | None
    """Which pairs these edges are: `Edges.edge_id`."""
    node_features: Float[Array, "N F"]
    edge_features: Float[Array, "2 E G"]
    weight: Float[Array, " E"]
    """SmoothCutoff of every edge in [0, 1]; 0 for edges that are no candidates."""
    embedding: Float[Array, "E M"]


class ContactDynamics(eqx.Module):
    """Predicts which edges are active and how the nodes move, one step at a time.

    Every function here takes one scene at one step; `jax.vmap` makes batches. Raises
    `InvalidInputError` where the number of edge types and of networks for them disagree.
    """

    inference: RecurrentEdges | MemorylessEdges | AllEdges
    local_dynamics: SpringMassDamperDynamics | FreeLinearDynamics
    features: InvariantFeatures | AbsoluteFeatures
    prior: DistancePrior | ClosestApproachPrior
    cutoff: SmoothCutoff | NoCutoff
    sample: ArgmaxSample | GumbelSample
    dt: float = eqx.field(static=True)
    """s"""
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)
    neighbor_list: NeighborList | None = None
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
        if self.neighbor_list is not None and not isinstance(self.cutoff, SmoothCutoff):
            raise InvalidInputError(
                "neighbor_list: lists of near pairs need a SmoothCutoff, beyond which no edge is "
                f"active; found {type(self.cutoff).__name__}"
            )

    def encode(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        control_displacement: Float[Array, "N D"] | None = None,
        contact_distance: Float[Array, " E"] | None = None,
    ) -> EncodedGraph:
        """What does not depend on the belief: geometry, features and edge embeddings.

        ``contact_distance`` [m]: at which the ends of each edge touch; None: as the model knows it.
        """
        edges = self._edges(position, velocity, nodes, control_displacement)
        if edges.edge_id is not None:
            # What outgrows a list has no prediction, for anybody.
            velocity = jnp.where(edges.fits, velocity, jnp.nan)
        touch = self.features.contact_distance if contact_distance is None else contact_distance
        seen = geometry(
            position, velocity, edges.pairs, self.dt, touch, control_displacement, nodes.anchor
        )
        node_features = self.features.node(position, velocity, nodes)
        edge_features = self.features.edge(seen, contact_distance)
        exists = edges.candidate(nodes.candidate) & nodes.mask[seen.first] & nodes.mask[seen.second]
        weight = jnp.where(exists, self.cutoff(seen), 0.0)
        ends = jnp.stack([seen.first, seen.second])
        embedding = self.inference.embed(node_features, edge_features, weight, ends)
        return EncodedGraph(seen, edges.edge_id, node_features, edge_features, weight, embedding)

    def _edges(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        nodes: Nodes,
        control_displacement: Float[Array, "N D"] | None,
    ) -> Edges:
        if self.neighbor_list is None:
            return all_pairs(position.shape[0])
        assert isinstance(self.cutoff, SmoothCutoff)
        way = travel_bound(position, velocity, control_displacement, nodes.anchor, self.dt)
        return self.neighbor_list(position, way, nodes.mask, self.cutoff.outer)

    def prior_belief(self, percept: EncodedGraph) -> ContactBelief:
        """What distance alone says, the active part spread evenly over the active types."""
        active = self.prior(percept.geometry, self.features.contact_distance) * percept.weight
        active_types = self.inference.edge_types - 1
        spread = jnp.repeat(active[:, None] / active_types, active_types, axis=-1)
        types = jnp.concatenate([1.0 - active[:, None], spread], axis=-1)
        return ContactBelief(types, percept.edge_id)

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before anything was seen: the distance prior."""
        return self.prior_belief(self.encode(position, velocity, nodes))

    def predict_belief(self, belief: ContactBelief, percept: EncodedGraph) -> ContactBelief:
        """The belief about the coming step. An edge out of reach is inactive, surely."""
        count = pair_count(percept.node_features.shape[0])
        before = belief.over(percept.edge_id, count)
        free = self.inference.predict(before, percept.embedding)
        active = free.type_probability[:, 1:] * percept.weight[:, None]
        inactive = 1.0 - jnp.sum(active, axis=-1, keepdims=True)
        return ContactBelief(jnp.concatenate([inactive, active], axis=-1), percept.edge_id)

    def local_input(
        self,
        percept: EncodedGraph,
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
            node_type=self.features.node_type(nodes, position.dtype),
            actuated=nodes.actuated.astype(position.dtype),
            node_features=percept.node_features,
            edge_features=percept.edge_features,
            weight=edge_active[:, 1:] * percept.weight[:, None],
            geometry=percept.geometry,
            anchor=nodes.anchor,
            group_capacity=None
            if self.neighbor_list is None
            else self.neighbor_list.group_capacity,
        )

    def linear_step(self, state: ModelState, nodes: Nodes) -> tuple[LinearDynamics, ContactBelief]:
        """The linear dynamics of the coming step, and the belief they rest on.

        Neither depends on the control but through ``state.control_displacement``.
        """
        percept = self.encode(state.position, state.velocity, nodes, state.control_displacement)
        belief = self.predict_belief(state.belief, percept)
        local = self.local_input(percept, belief, state.position, state.velocity, nodes)
        return self.local_dynamics(local, self.dt, self.control_size), belief

    def step(self, state: ModelState, control: Float[Array, " U"], nodes: Nodes) -> ModelState:
        """The next state under a control [N]."""
        return take_step(self, state, control_sensitivity(self, state, nodes), control, nodes)[0]

    def rollout(self, state: ModelState, controls: Float[Array, "H U"], nodes: Nodes) -> ModelState:
        """All states that follow, ``[H, …]``; belief h is about the step that led to state h."""
        first = dataclasses.replace(state, control_displacement=None)
        # Of large scenes gradients compute anew what they need: it would fill the memory.
        large = edge_count(self.neighbor_list, nodes.mask.shape[0]) > _MANY_EDGES
        return rollout(self, first, controls, nodes, jax.checkpoint if large else None)

    def parameters(self, state: ModelState, nodes: Nodes) -> SpringMassDamper:
        """The spring-mass-damper parameters of the coming step, each [N, D].

        Raises `TypeError` where the local dynamics have no such parameters.
        """
        if not isinstance(self.local_dynamics, SpringMassDamperDynamics):
            raise TypeError(f"{type(self.local_dynamics).__name__} has no spring-mass-damper")
        percept = self.encode(state.position, state.velocity, nodes)
        belief = self.predict_belief(state.belief, percept)
        local = self.local_input(percept, belief, state.position, state.velocity, nodes)
        return self.local_dynamics.parameters(local, self.dt, self.control_size)


class _LinearModel(Protocol):
    def linear_step(
        self, state: ModelState, nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]: ...


@eqx.filter_jit
def _linear_step(
    model: _LinearModel, state: ModelState, nodes: Nodes
) -> tuple[LinearDynamics, ContactBelief]:
    """Traced once, however often a program takes a step."""
    return model.linear_step(state, nodes)


def control_sensitivity(
    model: _LinearModel, state: ModelState, nodes: Nodes
) -> Float[Array, "N D U"]:
    """[m/N] How far each node is moved by the control, if only the present contacts hold."""
    unpushed = dataclasses.replace(state, control_displacement=jnp.zeros_like(state.velocity))
    held = nodes._replace(candidate=_holding(state, nodes))
    linear, _ = _linear_step(model, unpushed, held)
    return response_of(linear, state.position)


def _holding(state: ModelState, nodes: Nodes) -> Bool[Array, " E"]:
    believed = state.belief.over(None, nodes.candidate.shape[0])
    return nodes.candidate & (believed.probability > 0.5)


def with_control_displacement(
    state: ModelState, response: Float[Array, "N D U"], control: Float[Array, " U"]
) -> ModelState:
    """The state, told how far the coming step's control [N] alone moves each node."""
    control_displacement = jnp.sum(response * control, axis=-1)
    return dataclasses.replace(
        state, control_displacement=control_displacement.astype(state.velocity.dtype)
    )


def response_of(linear: LinearDynamics, like: Array) -> Float[Array, "N D U"]:
    """[m/N] The response in the step after one of these dynamics; of `like`'s number type."""
    return linear.B[..., 0, :].astype(like.dtype)


def take_step(
    model: _LinearModel,
    state: ModelState,
    response: Float[Array, "N D U"],
    control: Float[Array, " U"],
    nodes: Nodes,
) -> tuple[ModelState, Float[Array, "N D U"], LinearDynamics]:
    """One step under a control [N]: the next state, the response after it, and the dynamics.

    States keep their number types: a model of float32 may meet states of float64.
    """
    linear, belief = _linear_step(model, with_control_displacement(state, response, control), nodes)
    position, velocity = linear(state.position, state.velocity, control)
    after = ModelState(
        position=position.astype(state.position.dtype),
        velocity=velocity.astype(state.velocity.dtype),
        belief=cast_like(belief, state.belief),
    )
    return after, response_of(linear, response), linear


def rollout(
    model: _LinearModel,
    state: ModelState,
    controls: Float[Array, "H U"],
    nodes: Nodes,
    wrapped: Callable[[Callable], Callable] | None = None,
) -> ModelState:
    """All states that follow, ``[H, …]``; ``wrapped`` is each step's function, if by something.

    As `take_step` from the `control_sensitivity` on, which a turn of the same loop finds before
    the first step, so that a program holds one step and one derivative of it, not two.
    """
    holds = _holding(state, nodes)

    def step(
        carry: tuple[ModelState, Float[Array, "N D U"]], told: tuple[Array, Array]
    ) -> tuple[tuple[ModelState, Float[Array, "N D U"]], ModelState]:
        before, response = carry
        control, begins = told
        candidate = jnp.where(begins, holds, nodes.candidate)
        known = nodes._replace(candidate=candidate)
        after, response, _ = take_step(model, before, response, control, known)
        after = jax.tree.map(lambda old, new: jnp.where(begins, old, new), before, after)
        return (after, response), after

    unknown = jnp.zeros((*state.position.shape, controls.shape[-1]), state.position.dtype)
    begins = jnp.arange(controls.shape[0] + 1) == 0
    told = jnp.concatenate([jnp.zeros_like(controls[:1]), controls]), begins
    each = step if wrapped is None else wrapped(step)
    _, states = jax.lax.scan(each, (state, unknown), told)
    return jax.tree.map(lambda leaf: leaf[1:], states)


def cast_like(belief: ContactBelief, other: ContactBelief) -> ContactBelief:
    """The belief in the number type of another, which may be about other edges."""
    types = belief.type_probability.astype(other.type_probability.dtype)
    return dataclasses.replace(belief, type_probability=types)
