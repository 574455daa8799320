"""Rollouts of a model from every state of a recorded trajectory, in one compiled function."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data import TrajectoryBatch
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    LinearDynamics,
    ModelState,
    MotionNoise,
    StepModel,
    rollout,
)
from contactgraph.model.filter import filter_trajectory
from contactgraph.model.neighbor_list import edge_count

_SMALL_GRAPH = 28
"""Edges up to which batched rollouts are faster on a CPU than sequential ones (at 66 edges the
batch is twice as slow, by measurement)."""
_BATCH = 16


class TrajectoryPrediction(eqx.Module):
    """Rollouts of ``H`` steps from ``S`` states of a trajectory, under its recorded controls."""

    position: Float[Array, "S H N D"]
    """m"""
    edge_active: Bool[Array, "S H E"]
    """Whether each edge is more likely active than not; entry h is about step h of the window."""
    now_active: Bool[Array, "T+1 E"]
    """The same for the step that led to each state, corrected by what was observed there."""
    next_active: Bool[Array, "T+1 E"]
    """The same for the step after each state, predicted from that state."""


@eqx.filter_jit
def predict_trajectory(
    model: StepModel,
    trajectory: TrajectoryBatch[Array],
    starts: Int[Array, " S"],
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> TrajectoryPrediction:
    """Rolls the model out for ``steps`` from each of the states ``starts``."""
    filtered = filter_trajectory(model, trajectory, sensor, motion_noise)
    edges = trajectory.nodes.candidate.shape[-1]

    def likely(belief: ContactBelief) -> Array:
        return sensor.contact_probability(belief.over(None, edges)) > 0.5

    def from_state(start: Array) -> tuple[Array, Array]:
        belief = jax.tree.map(lambda leaf: leaf[start], filtered.posterior)
        state = ModelState(trajectory.position[start], trajectory.velocity[start], belief)
        controls = jax.lax.dynamic_slice_in_dim(trajectory.control, start, steps)

        def output(after: ModelState, _: LinearDynamics) -> tuple[Array, Array]:
            return after.position, likely(after.belief)

        return rollout(model, state, controls, trajectory.nodes, output)

    count = starts.shape[0]
    considered = edges
    if isinstance(model, ContactDynamics):
        considered = edge_count(model.neighbor_list, trajectory.position.shape[1])
    batch = min(_BATCH, count) if considered <= _SMALL_GRAPH else 1
    # A last batch of another size would compile the rollout a second time.
    padded = jnp.pad(starts, (0, -count % batch), mode="edge")
    position, active = jax.lax.map(from_state, padded, batch_size=batch if batch > 1 else None)
    return TrajectoryPrediction(
        position[:count],
        active[:count],
        jax.lax.map(likely, filtered.posterior),
        jax.lax.map(likely, filtered.prior),
    )
