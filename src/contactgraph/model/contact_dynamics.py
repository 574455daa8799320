"""The model, and its step in the paper's order.

One step is ``encode`` (the graph, independent of the belief), ``predict_belief`` (which edges will
be active), ``cut_edges`` (sample them and remove the others), ``linearize`` (local dynamics given
the active edges), and the linear step. Training encodes all states at once, then calls the others.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import pair_count
from contactgraph.data.turns import coordinate_count
from contactgraph.model.collision import (
    Geometry,
    NoCutoff,
    SmoothCutoff,
)
from contactgraph.model.contact_belief import (
    ArgmaxSample,
    ContactBelief,
    ContactSensor,
    GumbelSample,
    spread_over_types,
)
from contactgraph.model.contact_law import ContactLaw
from contactgraph.model.edge_inference import EdgeInference
from contactgraph.model.features import Features, shaped
from contactgraph.model.local_dynamics import (
    LocalDynamics,
    SpringMassDamperDynamics,
    in_substeps,
    step_geometry,
)
from contactgraph.model.motion_noise import PredictionNoise
from contactgraph.model.neighbor_list import (
    Edges,
    NeighborList,
    all_pairs,
    edge_count,
    travel_bound,
)
from contactgraph.model.rollout import control_sensitivity, rollout, take_step
from contactgraph.model.shapes import Meeting
from contactgraph.model.types import (
    EncodedGraph,
    LinearDynamics,
    LocalInput,
    ModelState,
    Nodes,
    SpringMassDamper,
    Step,
    StepStages,
)

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
    neighbor_list: NeighborList | None = None
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
        command: Float[Array, " U"] | None = None,
        contact_distance: Float[Array, " E"] | None = None,
        meeting: Meeting | None = None,
    ) -> EncodedGraph:
        """Stage 1: geometry, features and edge embeddings.

        ``control_displacement`` and ``command`` are those of a `ModelState`; ``contact_distance``
        [m] is each edge's own, None: that of the features. ``meeting`` is that of another graph of
        these positions, where it is known.
        """
        nodes = shaped(nodes, self.features, self.dimension)
        moved = position, velocity, control_displacement, nodes.anchor, self.dt
        bound = travel_bound(*moved, nodes.half_size, nodes.outlines)
        edges = self._edges(position, bound, nodes.mask)
        # A step that exceeds a capacity predicts NaN for every node.
        moving = velocity if edges.edge_id is None else jnp.where(edges.fits, velocity, jnp.nan)
        touch = self.features.distances(nodes, edges.edge_index, position.dtype)
        touch = touch if contact_distance is None else contact_distance
        if meeting is None or self.neighbor_list is not None:
            meeting = self.features.meeting(nodes, position, edges.edge_index)
        step = nodes, edges.edge_index, self.dt, touch, meeting, control_displacement
        points = step_geometry(self.features, self.local_dynamics, (position, moving), *step)
        edge_geometry = points.first(edges.edge_index.shape[1])
        node_features = self.features.node(position, moving, nodes)
        edge_features = self.features.edge(edge_geometry)
        exists = edges.select(nodes.candidate) & jnp.all(nodes.mask[edges.edge_index], axis=0)
        exists &= jnp.any(nodes.actuated[edges.edge_index], axis=0) | (not self.star)
        weight = jnp.where(exists, self.cutoff(edge_geometry), 0.0)
        command = jnp.zeros(self.control_size) if command is None else command
        seen = self.inference.edge_inputs(edge_features, edge_geometry, nodes, command)
        embedding = self.inference.embed(node_features, seen, weight, edges.edge_index)
        return EncodedGraph(
            position=position,
            velocity=velocity,
            nodes=nodes,
            geometry=edge_geometry,
            contact_points=points,
            meeting=meeting,
            edge_id=edges.edge_id,
            node_features=node_features,
            edge_features=edge_features,
            weight=weight,
            embedding=embedding,
            prior=self._prior(edge_geometry, weight),
            control_displacement=control_displacement,
        )

    def encode_state(self, state: ModelState, nodes: Nodes, *given: PyTree) -> EncodedGraph:
        """`encode` of a state; ``given`` are the arguments after the command."""
        known = state.control_displacement, state.command, *given
        return self.encode(state.position, state.velocity, nodes, *known)

    def _prior(self, geometry: Geometry, weight: Float[Array, " E"]) -> Float[Array, "E K"]:
        """The prior by distance, its active part spread evenly over the active types."""
        return spread_over_types(self.prior(geometry) * weight, self.inference.edge_types)

    def _edges(self, position: Array, bound: Float[Array, " N"], mask: Array) -> Edges:
        if self.neighbor_list is None:
            return all_pairs(len(position))
        assert isinstance(self.cutoff, SmoothCutoff)
        return self.neighbor_list(position[:, : self.dimension], bound, mask, self.cutoff.outer)

    def predict_belief(self, belief: ContactBelief, graph: EncodedGraph) -> ContactBelief:
        """Stage 2: the belief about the step. An edge beyond the cutoff is inactive, surely."""
        return self.predict_joint(belief, graph)[0]

    def predict_joint(
        self, belief: ContactBelief, graph: EncodedGraph
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the step, and the probability of each pair of types before and after."""
        before = belief.over(graph.edge_id, pair_count(len(graph.position)))
        free, joint = self.inference.predict(before, graph.embedding, graph.prior)
        active = free.type_probability[:, 1:] * graph.weight[:, None]
        types = jnp.concatenate([1.0 - jnp.sum(active, axis=-1, keepdims=True), active], axis=-1)
        cut = joint[:, :, 1:] * (1.0 - graph.weight[:, None, None])
        joint = joint.at[:, :, 1:].add(-cut).at[:, :, 0].add(jnp.sum(cut, axis=-1))
        memory = jax.tree.map(lambda each: each * graph.weight[:, None], free.memory)
        return ContactBelief(types, graph.edge_id, memory), joint

    def cut_edges(
        self, graph: EncodedGraph, belief: ContactBelief, key: PRNGKeyArray | None = None
    ) -> LocalInput:
        """Stage 3: the graph without the edges that are sampled as inactive."""
        edge_active = self.sample(belief.type_probability, key)
        dtype, capacity = graph.position.dtype, self.neighbor_list
        return LocalInput(
            position=graph.position,
            velocity=graph.velocity,
            node_type=self.features.node_type(graph.nodes, dtype),
            actuated=graph.nodes.actuated.astype(dtype),
            node_features=graph.node_features,
            edge_features=graph.edge_features,
            weight=edge_active[:, 1:] * graph.weight[:, None],
            geometry=graph.geometry,
            points=graph.contact_points,
            turns=self.features.turns(graph.nodes, dtype),
            anchor=graph.nodes.anchor,
            nodes=graph.nodes,
            control_displacement=graph.control_displacement,
            group_capacity=None if capacity is None else capacity.group_capacity,
        )

    def linearize(self, local: LocalInput) -> LinearDynamics:
        """Stage 4: the linear dynamics of every node, given the active edges."""
        step = self.dt, self.control_size, self.substeps
        return in_substeps(self.features, self.local_dynamics, local, *step)

    def stages(
        self, state: ModelState, nodes: Nodes, key: PRNGKeyArray | None = None
    ) -> StepStages:
        """All stages of one step, with their intermediate results."""
        graph = self.encode_state(state, nodes)
        belief = self.predict_belief(state.belief, graph)
        local = self.cut_edges(graph, belief, key)
        return StepStages(graph, belief, local, self.linearize(local))

    def linear_step(self, state: ModelState, nodes: Nodes) -> tuple[LinearDynamics, ContactBelief]:
        """The next step's dynamics and the belief that they assume, given the intended control."""
        stages = self.stages(state, nodes)
        return stages.dynamics, stages.belief

    def drive(
        self,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        control: Float[Array, " U"],
        nodes: Nodes,
    ) -> Float[Array, " W"]:
        """What moves bodies: the accelerations of a `ContactLaw`, else the control."""
        local = self.local_dynamics
        if not isinstance(local, SpringMassDamperDynamics) or not isinstance(
            head := local.head, ContactLaw
        ):
            return control
        step = Step(local.discretization.theta, self.dt, self.control_size)
        given = control, self.features.node_type(nodes, position.dtype), nodes, step
        return head.actuation.drive(position, velocity, *given, head.slots)

    def prior_belief(self, graph: EncodedGraph) -> ContactBelief:
        """The belief of the inference before any observation."""
        first = self.inference.init(graph.embedding, graph.prior)
        return dataclasses.replace(first, edge_id=graph.edge_id)

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before the first observation: the prior."""
        return self.prior_belief(self.encode(position, velocity, nodes))

    def step(self, state: ModelState, control: Float[Array, " U"], nodes: Nodes) -> ModelState:
        """The next state under a control [N]."""
        return take_step(self, state, control_sensitivity(self, state, nodes), control, nodes)[0]

    def rollout(self, state: ModelState, controls: Float[Array, "H U"], nodes: Nodes) -> ModelState:
        """All following states, ``[H, …]``; belief h is about the step that led to state h."""
        first = dataclasses.replace(state, control_displacement=None)
        large = edge_count(self.neighbor_list, nodes.mask.shape[0]) > _CHECKPOINTED_EDGES
        return rollout(self, first, controls, nodes, checkpoint=large)

    def parameters(self, state: ModelState, nodes: Nodes) -> SpringMassDamper:
        """Parameters of the next step, each [N, D]; `TypeError` where the dynamics have none."""
        if not isinstance(self.local_dynamics, SpringMassDamperDynamics):
            raise TypeError(f"{type(self.local_dynamics).__name__} has no spring-mass-damper")
        local = self.stages(state, nodes).local
        return self.local_dynamics.parameters(local, self.dt, self.control_size)
