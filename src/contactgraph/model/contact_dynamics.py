"""The model, and its step in the paper's order.

One step is ``encode`` (the graph, independent of the belief), ``predict_belief`` (which edges will
be active), ``cut_edges`` (sample them and remove the others), ``linearize`` (local dynamics given
the active edges), and the linear step. Training encodes all states at once, then calls the others.
"""

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from contactgraph.bodies.geometry import Geometry, Meeting, Rows, geometry, travel_bound
from contactgraph.bodies.graph import (
    Bodies,
    EdgeList,
    EncodedGraph,
    all_pairs,
    edge_count,
    edge_nodes,
)
from contactgraph.bodies.mass_matrix import GroupCapacity
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_count
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.data.turns import coordinate_count
from contactgraph.dynamics.local_dynamics import (
    LinearDynamics,
    LocalDynamics,
    SpringMassDamper,
)
from contactgraph.inference.contact_belief import (
    ArgmaxSample,
    ContactBelief,
    ContactSensor,
    GumbelSample,
    nothing_active,
    spread_over_types,
)
from contactgraph.inference.edge_inference import EdgeInference
from contactgraph.inference.features import Features, NoCutoff, SmoothCutoff, shaped
from contactgraph.inference.motion_noise import PredictionNoise
from contactgraph.model.step import ModelState, rollout, take_step

_TOUCHING = 1.02
"""Contact distance of an edge assumed active, in units of its distance: clearly touching."""
_CHECKPOINTED_EDGES = 500
"""Edges above which gradients of a rollout recompute each step instead of storing it."""


class ContactDynamics(eqx.Module):
    """Predicts which edges are active and how the nodes move, one step at a time.

    Every part is a constructor argument, and any object with the same methods can take its place:
    see `docs/extending.md`. Every method takes one scene at one step; `jax.vmap` makes batches.
    Raises `InvalidInputError` where the number of edge types and of networks for them disagree.
    """

    inference: EdgeInference
    local_dynamics: LocalDynamics
    features: Features
    prior: Callable[[Geometry], Float[Array, " E"]]
    cutoff: SmoothCutoff | NoCutoff
    sample: ArgmaxSample | GumbelSample
    dt: float = eqx.field(static=True)
    """s"""
    dimension: int = eqx.field(static=True)
    control_size: int = eqx.field(static=True)
    neighbor_list: EdgeList | None = None
    """Restricts edges to near pairs. None: every pair is an edge."""
    prediction_noise: PredictionNoise | None = None
    """Learned errors of the predicted motion. None: not learned."""
    sensor: ContactSensor | None = None
    """That of the data, as far as it was estimated: see `default_sensor`."""
    substeps: int = eqx.field(static=True, default=1)
    """Equal parts of a step, in each of which bodies touch where they then are."""
    star: bool = eqx.field(static=True, default=False)
    """Whether only edges of actuated nodes exist."""

    def __repr__(self) -> str:
        sizes = f"D={self.dimension}, U={self.control_size}, dt={self.dt:g} s"
        return f"ContactDynamics({type(self.inference).__name__}, {sizes})"

    @property
    def coordinates(self) -> int:
        """G, the coordinates of a body: see `generalized_coordinates`."""
        return coordinate_count(self.dimension, self.features.turn_length)

    def __check_init__(self) -> None:
        if not self.dt > 0:
            raise InvalidInputError(f"dt must be a positive number of seconds, found {self.dt}")
        active_types = len(self.inference.edge_types)
        networks = len(self.local_dynamics.message_passing.types)
        if active_types < 1 or networks != active_types:
            raise InvalidInputError(
                f"local_dynamics must have one message network for each of the {active_types} "
                f"active edge types (edge_types), found {networks}"
            )
        outer = getattr(self.cutoff, "outer", math.inf)
        if self.neighbor_list is not None and not math.isfinite(outer):
            raise InvalidInputError(
                "neighbor_list: lists of near pairs need a cutoff with a finite outer, such as a "
                f"SmoothCutoff; found {type(self.cutoff).__name__}"
            )

    def encode(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        control: Float[Array, " U"],
        nodes: Nodes,
        before: ContactBelief,
        meeting: Meeting | None = None,
        as_touching: bool = False,
    ) -> EncodedGraph:
        """Stage 1: geometry, features and edge embeddings.

        ``before`` is the belief in this state: what holds is moved together by the control.
        ``meeting`` is that of another graph of these positions, where it is known. ``as_touching``
        takes a contact distance of every edge so that its bodies touch at their closest approach.
        """
        bodies = self._bodies(position, velocity, nodes)
        nodes, edges = bodies.nodes, all_pairs(len(position))
        if self.neighbor_list is None:
            if meeting is None:
                meeting = self.features.meeting(nodes, position, edges.edge_index)
            displacement = self._control_displacement(bodies, control, before, meeting)
        else:
            displacement = self._control_displacement(bodies, control, before, None)
            bound = travel_bound(
                position,
                velocity,
                displacement,
                nodes.anchor,
                self.dt,
                half_size=nodes.half_size,
                outlines=nodes.outlines,
            )
            places = position[:, : self.dimension]
            edges = self.neighbor_list(places, bound, nodes.mask, self.cutoff.outer)
            meeting = self.features.meeting(nodes, position, edges.edge_index)
        # A step that exceeds a capacity predicts NaN for every node.
        moving = jnp.where(edges.fits, velocity, jnp.nan)
        bodies = bodies._replace(velocity=moving)
        edge_types = self.inference.edge_types
        alone = self._control_displacement(bodies, control, nothing_active(edge_types), None)
        driven = None
        if displacement is not None and alone is not None:
            # What holds meets as if it did not: a hold may end within the step.
            held = before.over(edges.edge_id, pair_count(len(position))).holding > 0.5
            held = jnp.resize(held, meeting.edge_index.shape[1:])[:, None]
            driven = jnp.where(held, meeting.relative(alone), meeting.relative(displacement))
        touch = self.features.distances(nodes, edges.edge_index, position.dtype)
        points = self._contact_points(bodies, self.dt, touch, meeting, driven)
        if as_touching:
            edge_geometry = points.first(edges.edge_index.shape[1])
            closest = _TOUCHING * edge_geometry.closest_approach
            touch = jnp.maximum(edge_geometry.contact_distance, closest)
            points = self._contact_points(bodies, self.dt, touch, meeting, driven)
        edge_geometry = points.first(edges.edge_index.shape[1])
        node_features = self.features.node(position, moving, nodes)
        edge_features = self.features.edge(edge_geometry)
        exists = edges.select(nodes.candidate) & jnp.all(nodes.mask[edges.edge_index], axis=0)
        exists &= jnp.any(nodes.actuated[edges.edge_index], axis=0) | (not self.star)
        weight = jnp.where(exists, self.cutoff(edge_geometry), 0.0)
        embedding = self.inference.embed(
            *(node_features, edge_features, weight, edges.edge_index),
            geometry=edge_geometry,
            nodes=nodes,
            control=control,
            displacement=alone,
        )
        return EncodedGraph(
            bodies=bodies,
            control=control,
            control_displacement=displacement,
            contact_points=points,
            edge_id=edges.edge_id,
            node_features=node_features,
            edge_features=edge_features,
            weight=weight,
            embedding=embedding,
            prior=spread_over_types(self.prior(edge_geometry) * weight, len(edge_types)),
            active=jnp.repeat(weight[:, None], len(edge_types), axis=1),
            edge_types=edge_types,
            group_capacity=self._group_capacity,
        )

    @property
    def _group_capacity(self) -> GroupCapacity | None:
        return None if self.neighbor_list is None else self.neighbor_list.groups

    def _bodies(self, position: Array, velocity: Array, nodes: Nodes) -> Bodies:
        nodes = shaped(nodes, self.features, self.dimension)
        node_type = self.features.node_type(nodes, position.dtype)
        turns = self.features.turns(nodes, position.dtype)
        return Bodies(position, velocity, nodes, node_type, turns)

    def _control_displacement(
        self,
        bodies: Bodies,
        control: Float[Array, " U"],
        before: ContactBelief,
        meeting: Meeting | None,
    ) -> Float[Array, "N D"] | None:
        """`EncodedGraph.control_displacement`; ``meeting``: of all pairs, where it is known."""
        nodes, (count, size) = bodies.nodes, bodies.position.shape
        edge_index, candidate = all_pairs(count).edge_index, nodes.candidate
        if before.edge_id is not None:
            edge_index, meeting = edge_nodes(before.edge_id, count), None
            candidate = candidate.at[before.edge_id].get(mode="fill", fill_value=False)
        if meeting is None and edge_index.shape[1]:
            meeting = self.features.meeting(nodes, bodies.position, edge_index)
        jacobian = jnp.ones((2, 0, self.dimension, size))
        if meeting is not None:  # The nearest places of all edges come first.
            jacobian = meeting.contact_jacobian[:, : edge_index.shape[1]]
        held = Rows(edge_index, jacobian)
        holds = candidate & jnp.all(nodes.mask[edge_index], axis=0) & (before.holding > 0.5)
        displacement = self.local_dynamics.control_displacement(
            bodies,
            control,
            held,
            holds.astype(bodies.position.dtype),
            dt=self.dt,
            capacity=self._group_capacity,
        )
        return None if displacement is None else displacement.astype(bodies.velocity.dtype)

    def control_displacement(
        self, state: ModelState, control: Float[Array, " U"], nodes: Nodes
    ) -> Float[Array, "N D"] | None:
        """`EncodedGraph.control_displacement`."""
        bodies = self._bodies(state.position, state.velocity, nodes)
        return self._control_displacement(bodies, control, state.belief, None)

    def _contact_points(
        self,
        bodies: Bodies,
        dt: float,
        contact_distance: Float[Array, "*E"] | float,
        meeting: Meeting,
        driven: Float[Array, "C D"] | None,
    ) -> Geometry:
        """`EncodedGraph.contact_points` of a step of ``dt`` [s]."""
        return geometry(
            meeting,
            velocity=bodies.velocity,
            dt=dt,
            contact_distance=jnp.resize(contact_distance, meeting.edge_index.shape[1:]),
            driven=driven,
            coasting=self.local_dynamics.coasting(bodies, dt),
            speed=self.features.speed,
        )

    def predict_belief(self, belief: ContactBelief, graph: EncodedGraph) -> ContactBelief:
        """Stage 2: the belief about the step. An edge beyond the cutoff is inactive, surely."""
        return self.predict_joint(belief, graph)[0]

    def predict_joint(
        self, belief: ContactBelief, graph: EncodedGraph
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the step, and the probability of each pair of types before and after."""
        before = belief.over(graph.edge_id, pair_count(len(graph.bodies.position)))
        free, joint = self.inference.predict(before, graph.embedding, graph.prior)
        types, joint = (_within_cutoff(each, graph) for each in (free.type_probability, joint))
        memory = jax.tree.map(lambda each: _weight(graph, each.ndim) * each, free.memory)
        return ContactBelief(types, graph.edge_id, memory, graph.edge_types), joint

    def transitions(self, graph: EncodedGraph) -> Float[Array, "E K A K"]:
        """`EdgeInference.transitions` of the step."""
        return _within_cutoff(self.inference.transitions(graph.embedding, graph.prior), graph)

    def cut_edges(
        self, graph: EncodedGraph, belief: ContactBelief, key: PRNGKeyArray | None = None
    ) -> EncodedGraph:
        """Stage 3: the graph without the edges that are sampled as inactive."""
        types = self.sample(belief.type_probability, key)
        return dataclasses.replace(graph, active=types[:, 1:] * graph.weight[:, None])

    def linearize(self, graph: EncodedGraph) -> LinearDynamics:
        """Stage 4: the linear dynamics of every node about the state and the control, given the
        active edges.

        A step of `substeps` parts goes on in each from where those before lead without control.
        The active edges, and the messages along them, are those of the step. No gradient flows
        through the beginnings of the parts.
        """
        if self.substeps == 1:
            linear = self.local_dynamics(graph, self.dt)
        else:
            linear = self._in_substeps(graph)
        bodies = graph.bodies
        position, velocity = linear(bodies.position, bodies.velocity, graph.control)
        after = bodies._replace(position=position, velocity=velocity)
        kept = self.local_dynamics.retract(bodies, after, dt=self.dt)
        if kept is after:
            return linear
        off = jnp.stack([kept.position - position, kept.velocity - velocity], axis=-1)
        return dataclasses.replace(linear, offset=linear.offset + off)

    def _in_substeps(self, graph: EncodedGraph) -> LinearDynamics:
        dt = self.dt / self.substeps
        start, still = graph.bodies, jnp.zeros_like(graph.control)

        def part(done: LinearDynamics, _: None) -> tuple[LinearDynamics, None]:
            position, velocity = done(start.position, start.velocity, still)
            after = start._replace(position=position, velocity=velocity)
            after = self.local_dynamics.retract(start, after, dt=dt)
            # Through all contacts of a rollout, each of which begins within a hair, gradients
            # overflow.
            position, velocity = jax.lax.stop_gradient((after.position, after.velocity))
            bodies = start._replace(position=position, velocity=velocity)
            meeting = self.features.meeting(start.nodes, position, graph.geometry.edge_index)
            touch = graph.geometry.contact_distance
            points = self._contact_points(bodies, dt, touch, meeting, None)
            there = dataclasses.replace(
                graph,
                bodies=bodies,
                contact_points=points,
                control_displacement=None,
            )
            return done.then(self.local_dynamics(there, dt)), None

        shapes = jax.eval_shape(lambda graph: self.local_dynamics(graph, dt), graph)
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        first = dataclasses.replace(nothing, A=nothing.A + jnp.eye(2, dtype=nothing.A.dtype))
        return jax.lax.scan(part, first, length=self.substeps)[0]

    def linear_step(
        self, state: ModelState, control: Float[Array, " U"], nodes: Nodes
    ) -> tuple[LinearDynamics, ContactBelief]:
        """The next step's dynamics under a control, and the belief that they assume."""
        graph = self.encode_state(state, control, nodes)
        belief = self.predict_belief(state.belief, graph)
        return self.linearize(self.cut_edges(graph, belief)), belief

    def encode_state(
        self, state: ModelState, control: Float[Array, " U"], nodes: Nodes
    ) -> EncodedGraph:
        """`encode` of a state."""
        return self.encode(state.position, state.velocity, control, nodes, state.belief)

    def prior_belief(self, graph: EncodedGraph) -> ContactBelief:
        """The belief of the inference before any observation."""
        first = self.inference.init(graph.embedding, graph.prior)
        return dataclasses.replace(first, edge_id=graph.edge_id, edge_types=graph.edge_types)

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before the first observation: the prior."""
        still = jnp.zeros(self.control_size, velocity.dtype)
        before = nothing_active(self.inference.edge_types)
        return self.prior_belief(self.encode(position, velocity, still, nodes, before))

    def step(self, state: ModelState, control: Float[Array, " U"], nodes: Nodes) -> ModelState:
        """The next state under a control [N]."""
        return take_step(self, state, control, nodes)[0]

    def rollout(self, state: ModelState, controls: Float[Array, "H U"], nodes: Nodes) -> ModelState:
        """All following states, ``[H, …]``; belief h is about the step that led to state h."""
        large = edge_count(self.neighbor_list, nodes.mask.shape[0]) > _CHECKPOINTED_EDGES
        return rollout(self, state, controls, nodes, checkpoint=large)

    def parameters(
        self, state: ModelState, control: Float[Array, " U"], nodes: Nodes
    ) -> SpringMassDamper:
        """Parameters of the next step, each [N, D]; `TypeError` where the dynamics have none."""
        graph = self.encode_state(state, control, nodes)
        graph = self.cut_edges(graph, self.predict_belief(state.belief, graph))
        return self.local_dynamics.parameters(graph, self.dt)


def _weight(graph: EncodedGraph, axes: int) -> Float[Array, "E ..."]:
    """That of the edges, to be multiplied with an array of so many axes."""
    return jnp.expand_dims(graph.weight, tuple(range(1, axes)))


def _within_cutoff(
    probability: Float[Array, "E *V K"], graph: EncodedGraph
) -> Float[Array, "E *V K"]:
    """Probabilities of the types after a step; beyond the cutoff none is active."""
    active = probability[..., 1:] * _weight(graph, probability.ndim)
    whole = jnp.sum(probability, axis=-1, keepdims=True)
    return jnp.concatenate([whole - jnp.sum(active, axis=-1, keepdims=True), active], axis=-1)
