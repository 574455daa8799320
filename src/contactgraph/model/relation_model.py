"""Relations without contact: the model, its training by expectation maximisation, and its preset.

Training infers the types of all edges of a trajectory from all its steps, without labels and
without a gradient. The force laws then minimise the expected negative log-likelihood of every
step's velocity, and the prior that of the types. At the start all laws are weak and the noise is
large, so that beliefs stay near the prior until the laws tell edges apart.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.bodies.shapes import Meeting
from contactgraph.data.trajectory_batch import TrajectoryBatch
from contactgraph.model.contact_belief import ContactBelief, nothing_active
from contactgraph.model.edges import DistancePrior, NoCutoff, all_pairs
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.force_laws import ExpectedTypes, RelationDynamics
from contactgraph.model.motion_likelihood import TrajectoryModel
from contactgraph.model.motion_noise import Motion, MotionNoise
from contactgraph.model.presets import ModelConfig
from contactgraph.model.relations import StaticEdges, lasting_types, motion_sums, with_evidence
from contactgraph.model.types import EncodedGraph, ModelState, Nodes

_EVERYWHERE = 1e9
"""Scale of the distance prior, m: 1/2 at every distance."""
_WEAK = 0.01
"""Share of a relation's greatest force, below which it is out of range."""


class RelationModel(TrajectoryModel):
    """Bodies that act on each other without contact, along pairs that last for a trajectory."""

    inference: StaticEdges  # type: ignore[assignment]
    local_dynamics: RelationDynamics  # type: ignore[assignment]
    sample: ExpectedTypes  # type: ignore[assignment]

    def prior_belief(self, graph: EncodedGraph) -> ContactBelief:
        """The belief before the first observation, by the types of the ends alone."""
        return self.inference.first_belief(graph.embedding)

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
        """As of all models, with a last part of the embedding: 1 for active types within range."""
        step = position, velocity, control, nodes, before
        graph = super().encode(*step, meeting, as_touching)
        types = self.features.node_type(nodes, position.dtype)
        between = graph.geometry.distance, graph.geometry.edge_index, types
        acts = jnp.max(self.local_dynamics.strength(*between), axis=0) > _WEAK
        embedding = jnp.concatenate([graph.embedding, acts], axis=-1)
        return dataclasses.replace(graph, embedding=embedding)

    def with_motion(
        self,
        carried: ContactBelief,
        before: ModelState,
        control: Float[Array, " U"],
        observed: Motion,
        nodes: Nodes,
        noise: MotionNoise,
    ) -> ContactBelief:
        """The belief after one more step, about all edges at once."""
        states = before.position, before.velocity, control, observed[1]
        _, effects, residual = self._evidence(nodes, *states)
        # Both velocities of a step are observed.
        scale = jnp.sqrt(self.local_dynamics.noise(effects) ** 2 + 2.0 * noise.velocity**2)
        return with_evidence(carried, *motion_sums(effects, residual, scale))

    def trajectory_belief(self, trajectory: TrajectoryBatch[Array]) -> ContactBelief:
        """The belief after the motion of all steps of one trajectory."""
        return self._posterior(*self._along(trajectory))

    def trajectory_loss(self, trajectory: TrajectoryBatch[Array]) -> Float[Array, ""]:
        """Expected negative log-likelihood, nat: of velocities and of types, each a mean."""
        embedding, *motion = self._along(trajectory)
        p = jax.lax.stop_gradient(lasting_types(self._posterior(embedding, *motion)))
        effects, residual = motion
        moved = effects.reshape(*effects.shape[:-1], *p[:, 1:].shape)
        expected = jnp.einsum("tndea,ea->tnde", moved, p[:, 1:])
        spread = jnp.einsum("tndea,ea->tnde", moved**2, p[:, 1:]) - expected**2
        error = (residual - jnp.sum(expected, -1)) ** 2 + jnp.sum(spread, -1)
        noise = self.local_dynamics.noise(jax.lax.stop_gradient(effects))[..., None]
        score = 0.5 * error / noise**2 + jnp.log(noise)
        nodes = trajectory.nodes
        counted = (_real_steps(trajectory)[:, None] & nodes.mobile)[..., None]
        surprise = -jnp.sum(p * embedding[:, : p.shape[1]], axis=-1)
        first, second = all_pairs(len(nodes.mask)).edge_index
        exists = nodes.candidate & nodes.mask[first] & nodes.mask[second]
        return _mean(score, counted) + _mean(surprise, exists)

    def _posterior(self, embedding: Array, effects: Array, residual: Array) -> ContactBelief:
        sums = motion_sums(effects, residual, self.local_dynamics.noise(effects))
        return with_evidence(self.inference.first_belief(embedding), *sums)

    def _along(
        self, trajectory: TrajectoryBatch[Array]
    ) -> tuple[Float[Array, "E K+active"], Float[Array, "T N D Z"], Float[Array, "T N D"]]:
        """The first state's embedding, and `RelationDynamics.evidence`, 0 in padding."""

        def of_step(*states: Array) -> tuple[Array, Array, Array]:
            return self._evidence(trajectory.nodes, *states)

        x, v = trajectory.position, trajectory.velocity
        states = x[:-1], v[:-1], trajectory.control, v[1:]
        embedding, effects, residual = jax.vmap(of_step)(*states)
        known = _real_steps(trajectory)[:, None, None]
        effects = jnp.where(known[..., None], effects, 0.0)
        return embedding[0], effects, jnp.where(known, residual, 0.0)

    def _evidence(
        self, nodes: Nodes, position: Array, velocity: Array, control: Array, after: Array
    ) -> tuple[Float[Array, "E K+active"], Float[Array, "N D Z"], Float[Array, "N D"]]:
        nothing = nothing_active(self.inference.edge_types)
        graph = self.encode(position, velocity, control, nodes, nothing)
        graph = self.cut_edges(graph, ContactBelief(graph.prior))
        evidence = self.local_dynamics.evidence(graph, self.dt, after)
        return graph.embedding, *evidence


def _real_steps(trajectory: TrajectoryBatch[Array]) -> Bool[Array, " T"]:
    return jnp.arange(len(trajectory.control)) < trajectory.steps


def _mean(values: Array, counted: Array) -> Array:
    """Over all that is counted; 0 where nothing is."""
    counted = jnp.broadcast_to(counted, values.shape)
    return jnp.sum(values, where=counted) / jnp.maximum(jnp.sum(counted), 1)


def relations(config: ModelConfig, *, key: PRNGKeyArray) -> RelationModel:
    """Force laws along all pairs that last for a trajectory: see `RelationDynamics`.

    ``config.contact_distance`` [m] is the unit of distances, about that of the bodies. Hinges,
    planes and impacts do not act in it.
    """
    types = config.node_types or ("object", "actuated")
    length, width = config.contact_distance, config.width or 32
    return RelationModel(
        inference=StaticEdges(len(types), config.edge_types),
        local_dynamics=RelationDynamics(length, len(types), config.edge_types, width, key=key),
        features=InvariantFeatures(length, learned=False, types=types),
        prior=DistancePrior(0.0, _EVERYWHERE, _EVERYWHERE),
        cutoff=NoCutoff(),
        sample=ExpectedTypes(),
        dt=config.dt,
        dimension=config.dimension,
        control_size=config.control_size,
    )
