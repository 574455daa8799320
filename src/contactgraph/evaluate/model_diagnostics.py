"""Diagnostics of a model: beliefs, parameters and growth along trajectories, and its memory."""

import math
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Trajectory,
    TrajectoryBatch,
    pad_trajectories,
    pair_indices,
    with_edge_labels,
)
from contactgraph.dynamics.local_dynamics import SpringMassDamper, SpringMassDamperDynamics
from contactgraph.evaluate.trajectory_prediction import filtered_beliefs
from contactgraph.inference.features import turn_length_of
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    LinearDynamics,
    ModelState,
    StepModel,
    default_sensor,
    rollout,
    stack_state,
)
from contactgraph.model.scene import check_fit, dtype_of, on_device, trajectory_for


@dataclass(frozen=True, eq=False)
class ModelDiagnostics:
    """A model's view of a trajectory of ``T`` steps; entry t is for the step from t to t + 1."""

    edges: np.ndarray
    """[E, 2] the nodes of each edge."""
    belief: np.ndarray
    """[T, E] probability of what the sensor means by contact, predicted from state t."""
    parameters: SpringMassDamper | None
    """Each [T, N, D]. None where the model has no such parameters."""

    def __repr__(self) -> str:
        return f"ModelDiagnostics(T={self.belief.shape[0]}, E={self.belief.shape[1]})"


def model_diagnostics(
    model: ContactDynamics,
    trajectory: Trajectory,
    *,
    sensor: ContactSensor | None = None,
    measured: bool = True,
    node_capacity: int | None = None,
) -> ModelDiagnostics:
    """Beliefs and parameters along a trajectory, each step predicted from its recorded state.

    ``measured``: whether recorded contacts correct the belief, as they do in closed loop, with the
    errors of ``sensor``, by default the model's `default_sensor`. Contacts are `with_edge_labels`.
    Raises `InvalidInputError` where model and trajectory do not fit, or the trajectory has more
    nodes than ``node_capacity`` (default: no padding).
    """
    check_fit(model, trajectory.scene, trajectory.control_size, "the trajectory")
    recorded = Dataset((trajectory,))
    labelled = with_edge_labels(recorded)
    count, edges = trajectory.scene.node_count, pair_indices(trajectory.scene.node_count)
    if sensor is None:
        sensor = replace(default_sensor(model), reports_touch=labelled is recorded)
    observed = trajectory_for(model, labelled.trajectories[0], node_capacity, contacts=measured)
    posterior, prior, *_ = filtered_beliefs(model, observed, sensor, None)
    parameters = None
    if isinstance(model.local_dynamics, SpringMassDamperDynamics):
        dimension = trajectory.scene.dimension  # turns are not drawn
        parameters = _parameters(model, observed, posterior)
        parameters = jax.tree.map(
            lambda leaf: np.asarray(leaf[:-1, :count, :dimension]), parameters
        )
    belief = np.asarray(sensor.contact_probability(prior))[:-1, : len(edges)]
    return ModelDiagnostics(edges, belief, parameters)


@eqx.filter_jit
def _parameters(
    model: ContactDynamics, trajectory: TrajectoryBatch[Array], posterior: ContactBelief
) -> SpringMassDamper:
    states = ModelState(trajectory.position, trajectory.velocity, posterior)
    # No control follows the last state.
    controls = jnp.concatenate([trajectory.control, jnp.zeros_like(trajectory.control[:1])])
    return jax.vmap(lambda state, u: model.parameters(state, u, trajectory.nodes))(states, controls)


def rollout_growth(model: StepModel, dataset: Dataset, steps: int) -> dict[str, float]:
    """Rolls the model out for ``steps`` from the first state of every trajectory.

    Growth is the largest norm of the state (all positions [m] and velocities [m/s]) in a rollout,
    over that of the first state; infinite where a prediction is not finite. The medians over
    trajectories are ``growth_free``, without any control, ``growth_driven``, under the recorded
    controls and then without control, and ``growth_recorded``, of the recorded trajectory itself.
    ``finite_rollouts`` is the share of rollouts, of both kinds, of which every number is finite.
    ``spectral_radius`` is the largest absolute eigenvalue of A in the first step, a median, too;
    ``spectral_radius_max`` that over all finite steps under the recorded controls, the largest of
    all. A lasting value above 1 is unstable.

    Raises `InvalidInputError` where ``steps`` is not positive, or model and data do not fit.
    """
    for each in dataset:
        check_fit(model, each.scene, each.control_size, "the data")
    if steps < 1:
        raise InvalidInputError(f"steps must be at least 1, found {steps}")
    longest, turn_length = max(steps, *(each.steps for each in dataset)), turn_length_of(model)
    batch = pad_trajectories(dataset, steps=longest, turn_length=turn_length)
    device = on_device(batch, dtype_of(model))
    moved = np.concatenate([batch.position, batch.velocity], axis=-1)
    norms = np.linalg.norm(moved, axis=(2, 3))
    recorded = norms[:, : steps + 1].max(axis=1) / norms[:, 0]
    free, driven, first_radius, radii = [], [], [], []
    for index in range(len(dataset)):
        one = device.at(index)
        controls = one.control[:steps]
        norm, _ = _rollout(model, one, jnp.zeros_like(controls))
        free.append(_growth(norm, norms[index, 0]))
        norm, radius = _rollout(model, one, controls)
        driven.append(_growth(norm, norms[index, 0]))
        first_radius.append(float(radius[0]))
        radii.append(np.asarray(radius, np.float64))
    every = np.concatenate(radii)
    return {
        "growth_steps": steps,
        "growth_free": float(np.median(free)),
        "growth_driven": float(np.median(driven)),
        "growth_recorded": float(np.median(recorded)),
        "finite_rollouts": float(np.mean(np.isfinite(free + driven))),
        "spectral_radius": float(np.median(first_radius)),
        "spectral_radius_max": float(max(every[np.isfinite(every)], default=math.inf)),
    }


def _growth(norm: Array, first: float) -> float:
    norms = np.asarray(norm, np.float64)
    return float(norms.max() / first) if np.isfinite(norms).all() else math.inf


@eqx.filter_jit
def _rollout(
    model: StepModel, trajectory: TrajectoryBatch[Array], controls: Float[Array, "T U"]
) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
    """Norm of every state from the first one on, and the spectral radius of every step's A."""
    nodes = trajectory.nodes

    def output(after: ModelState, linear: LinearDynamics) -> tuple[Array, Array]:
        exists = nodes.mask[:, None]
        motion = stack_state(
            jnp.where(exists, after.position, 0.0), jnp.where(exists, after.velocity, 0.0)
        )
        radius = jnp.where(exists, _spectral_radius(linear.A), 0.0)
        return jnp.linalg.norm(motion), jnp.max(radius)

    position, velocity = trajectory.position[0], trajectory.velocity[0]
    first = ModelState(position, velocity, model.initial_belief(position, velocity, nodes))
    return rollout(model, first, controls, nodes, output)


def _spectral_radius(A: Float[Array, "*N 2 2"]) -> Float[Array, "*N"]:
    """Of 2x2 blocks: the roots of ``z^2 - trace z + determinant``."""
    half = (A[..., 0, 0] + A[..., 1, 1]) / 2.0
    determinant = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]
    inside = half**2 - determinant
    real = jnp.abs(half) + jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.where(inside >= 0.0, real, jnp.sqrt(jnp.maximum(determinant, 0.0)))
