"""Rollouts of a model from every state of a recorded trajectory, in one compiled function."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.bodies.graph import edge_count
from contactgraph.data import Scene, Trajectory, TrajectoryBatch
from contactgraph.evaluate.baselines import turned
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    LinearDynamics,
    ModelState,
    MotionNoise,
    SmoothCutoff,
    StepModel,
    rollout,
    told_log_mass,
)
from contactgraph.model.body_mass import MassBelief, with_masses
from contactgraph.model.filter import filter_trajectory

_SMALL_GRAPH = 28
"""Edges up to which batched rollouts are faster on a CPU than sequential ones (at 66 edges the
batch is twice as slow, by measurement)."""
_BATCH = 16


class TrajectoryPrediction(eqx.Module):
    """Rollouts of ``H`` steps from ``S`` states of a trajectory, under its recorded controls.

    Beliefs are probabilities of what the sensor means by contact; see `contact_belief`.
    """

    position: Float[Array, "S H N D"]
    """m"""
    edge_active: Bool[Array, "S H E"]
    """Whether each edge is more likely active than not; entry h is about step h of the window."""
    last_belief: Float[Array, "S E"]
    """Of each edge in the last step of the window."""
    now_belief: Float[Array, "T+1 E"]
    """The same for the step that led to each state, corrected by what was observed there."""
    next_belief: Float[Array, "T+1 E"]
    """The same for the step after each state, predicted from that state."""
    masses: MassBelief | None
    """[T+1, N] by the motion up to each state. None: bodies of a type weigh alike."""


def largest_pin_gaps(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """[S] m: the largest `pin_gaps` of poses [S, H, N, 3], m and rad, in windows; infinite where a
    prediction is not finite, NaN where the scene has no pins."""
    if not len(scene.pins):
        return np.full(len(poses), np.nan)
    with np.errstate(invalid="ignore"):
        gap = pin_gaps(scene.pins, scene.pin_points, poses[..., :2], poses[..., 2])
    return np.where(np.isfinite(gap), gap, np.inf).max(axis=(1, 2))


def mass_errors(
    model: object, trajectory: Trajectory, masses: MassBelief | None
) -> np.ndarray | None:
    """[bodies, 2] error of the logarithm of the mass, and its standard deviation by the model.

    Of every body of unknown mass that touches another, at the end of its first contact, or of the
    trajectory. None where the model infers no masses, or the data tell none or no contacts.
    """
    contact = trajectory.contact
    if masses is None or contact is None:
        return None
    told, touched = told_log_mass(model, trajectory.scene), np.any(contact, axis=2)
    if told is None:
        return None
    unknown = np.asarray(masses.variance)[0, : touched.shape[1]] > 0.0
    found = []
    for node in np.flatnonzero(unknown & touched.any(axis=0)).tolist():
        begin = int(np.argmax(touched[:, node]))
        ended = np.flatnonzero(~touched[begin:, node])
        end = begin + int(ended[0]) if len(ended) else trajectory.steps
        error = float(masses.mean[end, node]) - told[node]
        found.append((error, float(masses.variance[end, node]) ** 0.5))
    return np.reshape(found, (-1, 2))


def contact_belief(
    model: StepModel, belief: ContactBelief, sensor: ContactSensor, edges: int
) -> Float[Array, " E"]:
    """Probability of what the sensor means by contact, over all pairs; NaN beyond the cutoff.

    The predicted belief in an active type is positive within the cutoff of a model that has one,
    and 0 beyond it. Of any other model, all beliefs count.
    """
    everywhere = belief.over(None, edges)
    probability = sensor.contact_probability(everywhere)
    if not (isinstance(model, ContactDynamics) and isinstance(model.cutoff, SmoothCutoff)):
        return probability
    within = jnp.sum(everywhere.type_probability[..., 1:], axis=-1) > 0
    return jnp.where(within, probability, jnp.nan)


def predict_trajectory(
    model: StepModel,
    trajectory: TrajectoryBatch[Array],
    starts: Int[Array, " S"],
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> TrajectoryPrediction:
    """Rolls the model out for ``steps`` from each of the states ``starts``.

    The rollouts are a function of their own, so that they are compiled once with and without a
    ``motion_noise``, which only the filter knows.
    """
    filtered = filtered_beliefs(model, trajectory, sensor, motion_noise)
    posterior, _, now, coming, masses = filtered
    unlabelled = trajectory._replace(contact=None)
    position, active, last = _rolled_out(
        model, unlabelled, posterior, masses, starts, steps, sensor
    )
    return TrajectoryPrediction(position, active, last, now, coming, masses)


@eqx.filter_jit
def filtered_beliefs(
    model: StepModel,
    trajectory: TrajectoryBatch[Array],
    sensor: ContactSensor,
    motion_noise: MotionNoise | None,
) -> tuple[ContactBelief, ContactBelief, Array, Array, MassBelief | None]:
    """Corrected and predicted beliefs, and a `TrajectoryPrediction`'s `now_belief`, `next_belief`
    and `masses`.

    It is compiled once for all pictures and numbers of trajectories of the same size.
    """
    filtered = filter_trajectory(model, trajectory, sensor, motion_noise)
    edges = trajectory.nodes.candidate.shape[-1]

    def believed(belief: ContactBelief) -> Array:
        return contact_belief(model, belief, sensor, edges)

    beliefs = (jax.lax.map(believed, each) for each in (filtered.posterior, filtered.prior))
    return filtered.posterior, filtered.prior, *beliefs, filtered.masses


@eqx.filter_jit
def _rolled_out(
    model: StepModel,
    trajectory: TrajectoryBatch[Array],
    posterior: ContactBelief,
    masses: MassBelief | None,
    starts: Int[Array, " S"],
    steps: int,
    sensor: ContactSensor,
) -> tuple[Array, Array, Array]:
    edges = trajectory.nodes.candidate.shape[-1]

    def from_state(start: Array) -> tuple[Array, Array, Array]:
        belief, mass = jax.tree.map(lambda leaf: leaf[start], (posterior, masses))
        nodes = with_masses(trajectory.nodes, mass)
        state = ModelState(trajectory.position[start], trajectory.velocity[start], belief)
        controls = jax.lax.dynamic_slice_in_dim(trajectory.control, start, steps)

        def output(after: ModelState, _: LinearDynamics) -> tuple[Array, Array]:
            return after.position, contact_belief(model, after.belief, sensor, edges)

        position, believed = rollout(model, state, controls, nodes, output)
        return position, believed > 0.5, believed[-1]

    count = starts.shape[0]
    considered = edges
    if isinstance(model, ContactDynamics):
        considered = edge_count(model.neighbor_list, trajectory.position.shape[1])
    batch = min(_BATCH, count) if considered <= _SMALL_GRAPH else 1
    # A last batch of another size would compile the rollout a second time.
    padded = jnp.pad(starts, (0, -count % batch), mode="edge")
    outputs = jax.lax.map(from_state, padded, batch_size=batch if batch > 1 else None)
    position, active, last = jax.tree.map(lambda leaf: leaf[:count], outputs)
    return position, active, last


def pin_gaps(
    pins: np.ndarray, pin_points: np.ndarray, position: np.ndarray, angle: np.ndarray
) -> np.ndarray:
    """[..., P] m: distance between the two points of each pin of bodies at ``position`` [..., N, 2]
    m and ``angle`` [..., N] rad."""
    ends = position[..., pins, :] + turned(pin_points, angle[..., pins])
    return np.asarray(np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1))
