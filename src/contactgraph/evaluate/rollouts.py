"""What a model predicts along a recorded run, and from every state of it on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    ModelState,
    MotionNoise,
    StepModel,
    advance,
    held_response,
)
from contactgraph.model.follow import follow_run
from contactgraph.model.neighbours import edge_count
from contactgraph.model.recording import Recording

_SMALL_GRAPH = 28
"""Edges up to which rollouts side by side are faster on a CPU than one after the other: from
there on the batch is in the way (twice as slow at 66 edges, by measurement)."""
_BATCH = 16


class RunPrediction(eqx.Module):
    """Rollouts of ``H`` steps from ``S`` states of a run, with its recorded controls."""

    position: Float[Array, "S H N D"]
    """m"""
    edge_active: Bool[Array, "S H E"]
    """Whether each edge is more likely active than not; entry h is about step h of the window."""
    coming_active: Bool[Array, "T+1 E"]
    """The same about the step after each state, as predicted from that state."""


@eqx.filter_jit
def predict_run(
    model: StepModel,
    run: Recording,
    starts: Int[Array, " S"],
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> RunPrediction:
    """Rolls the model out for ``steps`` from each of the states ``starts``."""
    carried = follow_run(model, run, sensor, motion_noise)
    edges = run.contact.shape[-1]

    def likely(belief: ContactBelief) -> Array:
        return belief.over(None, edges).probability > 0.5

    def from_state(start: Array) -> tuple[Array, Array]:
        belief = jax.tree.map(lambda leaf: leaf[start], carried.now)
        state = ModelState(run.position[start], run.velocity[start], belief)
        controls = jax.lax.dynamic_slice_in_dim(run.control, start, steps)

        Carry = tuple[ModelState, Float[Array, "N D U"]]

        def step(carry: Carry, control: Array) -> tuple[Carry, tuple[Array, Array]]:
            after, response, _ = advance(model, *carry, control, run.nodes)
            return (after, response), (after.position, likely(after.belief))

        response = held_response(model, state, run.nodes)
        return jax.lax.scan(step, (state, response), controls)[1]

    count = starts.shape[0]
    looked_at = edges
    if isinstance(model, ContactDynamics):
        looked_at = edge_count(model.neighbours, run.position.shape[1])
    batch = min(_BATCH, count) if looked_at <= _SMALL_GRAPH else 1
    # A last batch of another size would compile the rollout a second time.
    padded = jnp.pad(starts, (0, -count % batch), mode="edge")
    position, active = jax.lax.map(from_state, padded, batch_size=batch if batch > 1 else None)
    return RunPrediction(position[:count], active[:count], jax.lax.map(likely, carried.coming))
