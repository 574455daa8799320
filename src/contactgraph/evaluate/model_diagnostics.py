"""What a model believes and which parameters it infers along a recorded run."""

import math
from dataclasses import dataclass, fields

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
)
from contactgraph.model import (
    ContactDynamics,
    ContactSensor,
    ModelState,
    Nodes,
    StepModel,
    control_sensitivity,
    scene_nodes,
    stack_state,
    take_step,
)
from contactgraph.model.filter import check_fit, dtype_of, filter_trajectory, on_device
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.types import SpringMassDamper

_EXACT = ContactSensor()


@dataclass(frozen=True, eq=False)
class ModelDiagnostics:
    """One run of ``T`` steps, as a model sees it; entry t is about the step from t to t + 1."""

    edges: np.ndarray
    """[E, 2] the nodes of each edge."""
    belief: np.ndarray
    """[T, E] probability that each edge is active, predicted from state t."""
    parameters: SpringMassDamper | None
    """Each [T, N, D]. None where the model has no such parameters."""


def model_diagnostics(
    model: ContactDynamics,
    run: Trajectory,
    *,
    sensor: ContactSensor = _EXACT,
    measured: bool = True,
    node_capacity: int | None = None,
) -> ModelDiagnostics:
    """Goes along a run, predicting every step from the recorded state before it.

    ``measured``: whether recorded contacts correct the belief, as they do in closed loop.
    Raises `InvalidInputError` where model and run do not fit, or the run has more nodes than
    ``node_capacity`` (default: no padding).
    """
    check_fit(model, run.scene, run.control_size, "the run")
    count = run.scene.node_count
    capacity = count if node_capacity is None else node_capacity
    batch = pad_trajectories((run,), capacity, contacts=measured)
    padded = on_device(batch.at(0), dtype_of(model))
    edges = pair_indices(count)
    belief, parameters = _along(model, padded, sensor)
    if parameters is not None:
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf[:-1, :count]), parameters)
    return ModelDiagnostics(edges, np.asarray(belief)[:-1, : len(edges)], parameters)


@eqx.filter_jit
def _along(
    model: ContactDynamics, run: TrajectoryBatch[Array], sensor: ContactSensor
) -> tuple[jax.Array, SpringMassDamper | None]:
    carried = filter_trajectory(model, run, sensor)
    parameters = None
    if isinstance(model.local_dynamics, SpringMassDamperDynamics):
        states = ModelState(run.position, run.velocity, carried.posterior)
        parameters = jax.vmap(lambda state: model.parameters(state, run.nodes))(states)
    return carried.prior.probability, parameters


@dataclass(frozen=True)
class RolloutGrowth:
    """What `rollout_growth` measures, medians over runs; the names are the keys of `to_json`.

    Growth is the largest norm of the state (all positions [m] and velocities [m/s]) on the way,
    over that of the first state; infinite where a prediction is not finite.
    """

    growth_steps: int
    growth_free: float
    """Without any control."""
    growth_driven: float
    """Under the recorded controls; none after the run's end."""
    growth_recorded: float
    """Of the recorded run itself, to compare with."""
    finite_rollouts: float
    """Share of rollouts, both kinds, of which every number is finite."""
    spectral_radius: float
    """Largest absolute eigenvalue of A in the first step; above 1 it grows if it is kept up."""
    spectral_radius_max: float
    """The same over all finite steps under the recorded controls: the largest of any run."""

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not finite."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value if math.isfinite(value) else None for name, value in numbers.items()}


def rollout_growth(model: StepModel, dataset: Dataset, steps: int) -> RolloutGrowth:
    """Rolls the model out for ``steps`` from the first state of every run.

    Raises `InvalidInputError` where ``steps`` is not positive, or model and data do not fit.
    """
    for run in dataset:
        check_fit(model, run.scene, run.control_size, "the data")
    if steps < 1:
        raise InvalidInputError(f"steps must be at least 1, found {steps}")
    capacity = max(run.scene.node_count for run in dataset)
    dtype = dtype_of(model)
    growth: dict[str, list[float]] = {"free": [], "driven": [], "recorded": []}
    finite: list[bool] = []
    first_radius: list[float] = []
    all_radius: list[float] = []
    for run in dataset:
        nodes = scene_nodes(run.scene, capacity)
        position = np.zeros((capacity, run.scene.dimension), dtype)
        velocity = np.zeros_like(position)
        count = run.scene.node_count
        position[:count], velocity[:count] = run.position[0], run.velocity[0]
        controls = np.zeros((steps, run.control_size), dtype)
        known = min(steps, run.steps)
        controls[:known] = run.control[:known]
        begun = float(np.linalg.norm([position, velocity]))
        for name, pushes in (("free", np.zeros_like(controls)), ("driven", controls)):
            norm, radius = _rollout(model, nodes, position, velocity, pushes)
            norms = np.asarray(norm, np.float64)
            finite.append(bool(np.isfinite(norms).all()))
            growth[name].append(float(norms.max()) / begun if finite[-1] else math.inf)
            if name == "driven":
                radii = np.asarray(radius, np.float64)
                first_radius.append(float(radii[0]))
                all_radius += radii[np.isfinite(radii)].tolist()
        moved = np.concatenate([run.position, run.velocity], axis=-1)[: known + 1]
        growth["recorded"].append(float(np.linalg.norm(moved, axis=(1, 2)).max()) / begun)
    return RolloutGrowth(
        growth_steps=steps,
        growth_free=float(np.median(growth["free"])),
        growth_driven=float(np.median(growth["driven"])),
        growth_recorded=float(np.median(growth["recorded"])),
        finite_rollouts=float(np.mean(finite)),
        spectral_radius=float(np.median(first_radius)),
        spectral_radius_max=max(all_radius, default=math.inf),
    )


@eqx.filter_jit
def _rollout(
    model: StepModel,
    nodes: Nodes,
    position: np.ndarray,
    velocity: np.ndarray,
    controls: np.ndarray,
) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
    """Norm of every state that follows, and the spectral radius of every step's A.

    ``position`` and ``velocity`` [N, D], ``controls`` [T, U].
    """

    Carry = tuple[ModelState, Float[Array, "N D U"]]

    def step(carry: Carry, control: Array) -> tuple[Carry, tuple[Array, Array]]:
        after, response, linear = take_step(model, *carry, control, nodes)
        seen = nodes.mask[:, None]
        moved = stack_state(
            jnp.where(seen, after.position, 0.0), jnp.where(seen, after.velocity, 0.0)
        )
        radius = jnp.where(seen, _spectral_radius(linear.A), 0.0)
        return (after, response), (jnp.linalg.norm(moved), jnp.max(radius))

    start, speed = jnp.asarray(position), jnp.asarray(velocity)
    first = ModelState(start, speed, model.initial_belief(start, speed, nodes))
    begin = first, control_sensitivity(model, first, nodes)
    return jax.lax.scan(step, begin, jnp.asarray(controls))[1]


def _spectral_radius(A: Float[Array, "*N 2 2"]) -> Float[Array, "*N"]:
    """Of 2x2 blocks: the roots of ``z^2 - trace z + determinant``."""
    half = (A[..., 0, 0] + A[..., 1, 1]) / 2.0
    determinant = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]
    inside = half**2 - determinant
    real = jnp.abs(half) + jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.where(inside >= 0.0, real, jnp.sqrt(jnp.maximum(determinant, 0.0)))
