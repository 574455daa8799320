"""What a model predicts along a recorded run, and from every state of it on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control import StepModel
from contactgraph.data import Trajectory, pair_indices
from contactgraph.evaluate.scene_nodes import scene_nodes
from contactgraph.model import (
    ContactBelief,
    ContactSensor,
    ModelState,
    Nodes,
    advance,
    correct,
    held_response,
    in_types_of,
    pushed,
    response_of,
)

_SMALL_GRAPH = 28
"""Edges up to which rollouts side by side are faster on a CPU than one after the other: from
there on the batch is in the way (twice as slow at 66 edges, by measurement)."""
_BATCH = 16


class Recording(eqx.Module):
    """A run on the device, padded to capacities of ``T`` steps and ``N`` nodes."""

    position: Float[Array, "T+1 N D"]
    velocity: Float[Array, "T+1 N D"]
    control: Float[Array, "T U"]
    contact: Float[Array, "T+1 E"]
    """1 touching, 0 not, NaN not measured."""
    nodes: Nodes


class CarriedBelief(eqx.Module):
    """What is believed along a run, from its past alone."""

    now: ContactBelief
    """[T+1, E, K] about the step that led to each state, corrected by the contacts measured."""
    coming: ContactBelief
    """[T+1, E, K] predicted from each state about the step that follows it."""


class RunPrediction(eqx.Module):
    """Rollouts of ``H`` steps from ``S`` states of a run, with its recorded controls."""

    position: Float[Array, "S H N D"]
    """m"""
    edge_active: Bool[Array, "S H E"]
    """Whether each edge is more likely active than not; entry h is about step h of the window."""
    coming_active: Bool[Array, "T+1 E"]
    """The same about the step after each state, as predicted from that state."""


def recording(
    run: Trajectory, steps: int, node_capacity: int, dtype: np.dtype, measured: bool
) -> Recording:
    """Pads a run with zeros to ``steps`` and ``node_capacity``.

    Without ``measured``, or where the run has no contacts, none count as measured.
    """
    count = run.scene.node_count
    pairs = pair_indices(count)
    edges = node_capacity * (node_capacity - 1) // 2
    position = np.zeros((steps + 1, node_capacity, run.scene.dimension), dtype)
    velocity = np.zeros_like(position)
    control = np.zeros((steps, run.control_size), dtype)
    contact = np.full((steps + 1, edges), np.nan, dtype)
    position[: run.steps + 1, :count] = run.position
    velocity[: run.steps + 1, :count] = run.velocity
    control[: run.steps] = run.control
    if measured and run.contact is not None:
        # The edges of fewer nodes come first in the order of any capacity.
        contact[: run.steps + 1, : len(pairs)] = run.contact[:, pairs[:, 0], pairs[:, 1]]
    return Recording(
        jnp.asarray(position),
        jnp.asarray(velocity),
        jnp.asarray(control),
        jnp.asarray(contact),
        scene_nodes(run.scene, node_capacity),
    )


def number_type(model: StepModel) -> np.dtype:
    """The floating type of the model's weights; JAX's default where it has none."""
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
        return np.dtype(leaf.dtype)
    return np.dtype(jax.dtypes.canonicalize_dtype(np.float64))


def carry_belief(model: StepModel, run: Recording, sensor: ContactSensor) -> CarriedBelief:
    """The belief carried along a run: predicted for every step, then corrected by its contacts."""

    Carry = tuple[ContactBelief, Float[Array, "N D U"]]

    def follow(
        carry: Carry, step: tuple[Array, Array, Array, Array]
    ) -> tuple[Carry, CarriedBelief]:
        predicted, response = carry
        position, velocity, contact, control = step
        now = correct(predicted, contact, sensor)
        state = pushed(ModelState(position, velocity, now), response, control)
        linear, coming = model.linear_step(state, run.nodes)
        coming = in_types_of(coming, predicted)
        return (coming, response_of(linear, response)), CarriedBelief(now, coming)

    first = model.initial_belief(run.position[0], run.velocity[0], run.nodes)
    begin = ModelState(run.position[0], run.velocity[0], first)
    # No control follows the last state.
    control = jnp.concatenate([run.control, jnp.zeros_like(run.control[:1])])
    steps = run.position, run.velocity, run.contact, control
    return jax.lax.scan(follow, (first, held_response(model, begin, run.nodes)), steps)[1]


@eqx.filter_jit
def predict_run(
    model: StepModel, run: Recording, starts: Int[Array, " S"], steps: int, sensor: ContactSensor
) -> RunPrediction:
    """Rolls the model out for ``steps`` from each of the states ``starts``."""
    carried = carry_belief(model, run, sensor)

    def from_state(start: Array) -> tuple[Array, Array]:
        belief = jax.tree.map(lambda leaf: leaf[start], carried.now)
        state = ModelState(run.position[start], run.velocity[start], belief)
        controls = jax.lax.dynamic_slice_in_dim(run.control, start, steps)

        Carry = tuple[ModelState, Float[Array, "N D U"]]

        def step(carry: Carry, control: Array) -> tuple[Carry, tuple[Array, Array]]:
            after, response, _ = advance(model, *carry, control, run.nodes)
            return (after, response), (after.position, after.belief.probability > 0.5)

        response = held_response(model, state, run.nodes)
        return jax.lax.scan(step, (state, response), controls)[1]

    count, edges = starts.shape[0], run.contact.shape[-1]
    batch = min(_BATCH, count) if edges <= _SMALL_GRAPH else 1
    # A last batch of another size would compile the rollout a second time.
    padded = jnp.pad(starts, (0, -count % batch), mode="edge")
    position, active = jax.lax.map(from_state, padded, batch_size=batch if batch > 1 else None)
    return RunPrediction(position[:count], active[:count], carried.coming.probability > 0.5)
