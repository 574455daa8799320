"""Relations without contact: the model, its training, and its preset.

Bodies act on each other along pairs whose types last for a whole trajectory, such as springs. The
laws of force and the types of pairs are learned from motion alone: see `TrajectoryObjective`. The
core of the package imports nothing from here; a preset's name leads to it.
"""

import dataclasses
from functools import partial
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.graph import EncodedGraph, all_pairs
from contactgraph.data.trajectory_batch import Nodes, TrajectoryBatch
from contactgraph.inference.contact_belief import ContactBelief, nothing_active
from contactgraph.inference.features import ClosestApproachPrior, InvariantFeatures, NoCutoff
from contactgraph.inference.motion_noise import Motion, MotionNoise
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.presets import ModelConfig
from contactgraph.model.step import ModelState
from contactgraph.relations.force_laws import ExpectedTypes, RelationDynamics
from contactgraph.relations.inference import (
    MotionSums,
    StaticEdges,
    lasting_types,
    motion_sums,
    with_evidence,
)
from contactgraph.train.batch import WindowSource
from contactgraph.train.held_out import HeldOutWindows, steps_between
from contactgraph.train.objective import LossTerms
from contactgraph.train.window_loss import WindowObjective, masked_mean

_WEAK = 0.01
"""Share of a relation's greatest force, below which it is out of range."""


class RelationModel(ContactDynamics):
    """Bodies that act on each other without contact, along pairs that last for a trajectory."""

    inference: StaticEdges
    local_dynamics: RelationDynamics
    sample: ExpectedTypes  # type: ignore[assignment]

    @property
    def objective(self) -> "TrajectoryObjective":
        """What training minimises in place of the errors of windows."""
        return TrajectoryObjective()

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
        graph = super().encode(position, velocity, control, nodes, before, meeting, as_touching)
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
        effects, residual = self.evidence(nodes, *states)
        # Both velocities of a step are observed.
        scale = jnp.sqrt(self.local_dynamics.noise(effects) ** 2 + 2.0 * noise.velocity**2)
        return with_evidence(carried, *motion_sums(effects, residual, scale))

    def evidence(
        self,
        nodes: Nodes,
        position: Float[Array, "N D"],
        velocity: Float[Array, "N D"],
        control: Float[Array, " U"],
        after: Float[Array, "N D"],
    ) -> tuple[Float[Array, "N D Z"], Float[Array, "N D"]]:
        """`RelationDynamics.evidence` of a step; ``after`` is the velocity [m/s] after it."""
        nothing = nothing_active(self.inference.edge_types)
        graph = self.encode(position, velocity, control, nodes, nothing)
        graph = self.cut_edges(graph, ContactBelief(graph.prior))
        return self.local_dynamics.evidence(graph, self.dt, after)


class TrajectoryObjective(WindowObjective):
    """Expectation maximisation along whole trajectories.

    The types of all edges are inferred from all steps, without labels and without a gradient. The
    force laws then minimise the expected negative log-likelihood of every step's velocity, and the
    prior that of the types. At the start all laws are weak and the noise is large, so that beliefs
    stay near the prior until the laws tell edges apart.
    """

    rolls_out = False
    burn = 20

    def terms(
        self,
        model: RelationModel,  # type: ignore[override]
        windows: TrajectoryBatch[Array],
        source: WindowSource,
        key: PRNGKeyArray,
        devices: int,
    ) -> LossTerms:
        """The mean of `trajectory_loss` over as many trajectories as there are windows."""
        trajectories = source.draw_trajectories(len(windows.position), key).trajectories
        score = jnp.mean(jax.vmap(partial(trajectory_loss, model))(trajectories))
        return LossTerms.of(likelihood=score)

    @eqx.filter_jit
    def first_beliefs(  # type: ignore[override]
        self, model: RelationModel, held_out: HeldOutWindows, devices: int
    ) -> tuple[ContactBelief, TrajectoryBatch[Array]]:
        """By the motion of the steps before each window."""
        drawn = held_out.source.take(held_out.trajectory, held_out.start)
        before = steps_between(drawn, 0, held_out.burn)
        return jax.vmap(partial(trajectory_belief, model))(before), held_out.windows


def trajectory_belief(model: RelationModel, trajectory: TrajectoryBatch[Array]) -> ContactBelief:
    """The belief after the motion of all steps of one trajectory."""
    return _posterior(model, trajectory, *_evidence(model, trajectory))


def trajectory_loss(model: RelationModel, trajectory: TrajectoryBatch[Array]) -> Float[Array, ""]:
    """Expected negative log-likelihood, nat: of velocities and of types, each a mean."""
    effects, residual = _evidence(model, trajectory)
    posterior = _posterior(model, trajectory, effects, residual)
    p = jax.lax.stop_gradient(lasting_types(posterior))
    moved = effects.reshape(*effects.shape[:-1], *p[:, 1:].shape)
    expected = jnp.einsum("tndea,ea->tnde", moved, p[:, 1:])
    spread = jnp.einsum("tndea,ea->tnde", moved**2, p[:, 1:]) - expected**2
    error = (residual - jnp.sum(expected, -1)) ** 2 + jnp.sum(spread, -1)
    noise = model.local_dynamics.noise(jax.lax.stop_gradient(effects))[..., None]
    score = 0.5 * error / noise**2 + jnp.log(noise)
    nodes = trajectory.nodes
    counted = (_real_steps(trajectory)[:, None] & nodes.mobile)[..., None]
    surprise = -jnp.sum(p * cast(MotionSums, posterior.memory).log_prior, axis=-1)
    first, second = all_pairs(len(nodes.mask)).edge_index
    exists = nodes.candidate & nodes.mask[first] & nodes.mask[second]
    mean_score = masked_mean(score, jnp.broadcast_to(counted, score.shape))
    return mean_score + masked_mean(surprise, exists)


def _posterior(
    model: RelationModel, trajectory: TrajectoryBatch[Array], effects: Array, residual: Array
) -> ContactBelief:
    first = model.initial_belief(trajectory.position[0], trajectory.velocity[0], trajectory.nodes)
    sums = motion_sums(effects, residual, model.local_dynamics.noise(effects))
    return with_evidence(first, *sums)


def _evidence(
    model: RelationModel, trajectory: TrajectoryBatch[Array]
) -> tuple[Float[Array, "T N D Z"], Float[Array, "T N D"]]:
    """`RelationModel.evidence` of every step, 0 in padding."""
    x, v = trajectory.position, trajectory.velocity
    of_step = partial(model.evidence, trajectory.nodes)
    effects, residual = jax.vmap(of_step)(x[:-1], v[:-1], trajectory.control, v[1:])
    known = _real_steps(trajectory)[:, None, None]
    return jnp.where(known[..., None], effects, 0.0), jnp.where(known, residual, 0.0)


def _real_steps(trajectory: TrajectoryBatch[Array]) -> Bool[Array, " T"]:
    return jnp.arange(len(trajectory.control)) < trajectory.steps


def relations(config: ModelConfig, *, key: PRNGKeyArray) -> RelationModel:
    """Force laws along all pairs that last for a trajectory: see `RelationDynamics`.

    ``config.contact_distance`` [m] is the unit of distances, about that of the bodies. Hinges,
    planes and impacts do not act in it.
    """
    types = config.node_types or ("object", "actuated")
    length, width = config.contact_distance, config.width or 32
    return RelationModel(
        inference=StaticEdges(len(types), config.edge_types),
        local_dynamics=RelationDynamics(length, len(types), len(config.edge_types), width, key=key),
        features=InvariantFeatures(length, learned=False, types=types),
        prior=ClosestApproachPrior(),
        cutoff=NoCutoff(),
        sample=ExpectedTypes(),
        dt=config.dt,
        dimension=config.dimension,
        control_size=config.control_size,
    )
