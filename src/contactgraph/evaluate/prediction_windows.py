"""Errors and contacts of every window, for plots and for further cuts."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.data import Dataset, Trajectory, TrajectoryBatch, pad_trajectories, pair_indices
from contactgraph.evaluate.baselines import constant_velocity, frozen_contact
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    ContactSensor,
    ModelState,
    MotionNoise,
    ReallocatingModel,
    StepModel,
    control_sensitivity,
    take_step,
)
from contactgraph.model.filter import dtype_of, filter_trajectory, on_device
from contactgraph.model.neighbor_list import edge_count

_SMALL_GRAPH = 28
"""Edges up to which rollouts side by side are faster on a CPU than one after the other: from
there on the batch is in the way (twice as slow at 66 edges, by measurement)."""
_BATCH = 16


class TrajectoryPrediction(eqx.Module):
    """Rollouts of ``H`` steps from ``S`` states of a run, with its recorded controls."""

    position: Float[Array, "S H N D"]
    """m"""
    edge_active: Bool[Array, "S H E"]
    """Whether each edge is more likely active than not; entry h is about step h of the window."""
    coming_active: Bool[Array, "T+1 E"]
    """The same about the step after each state, as predicted from that state."""


@eqx.filter_jit
def predict_trajectory(
    model: StepModel,
    run: TrajectoryBatch[Array],
    starts: Int[Array, " S"],
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None = None,
) -> TrajectoryPrediction:
    """Rolls the model out for ``steps`` from each of the states ``starts``."""
    carried = filter_trajectory(model, run, sensor, motion_noise)
    edges = run.nodes.candidate.shape[-1]

    def likely(belief: ContactBelief) -> Array:
        return belief.over(None, edges).probability > 0.5

    def from_state(start: Array) -> tuple[Array, Array]:
        belief = jax.tree.map(lambda leaf: leaf[start], carried.posterior)
        state = ModelState(run.position[start], run.velocity[start], belief)
        controls = jax.lax.dynamic_slice_in_dim(run.control, start, steps)

        Carry = tuple[ModelState, Float[Array, "N D U"]]

        def step(carry: Carry, control: Array) -> tuple[Carry, tuple[Array, Array]]:
            after, response, _ = take_step(model, *carry, control, run.nodes)
            return (after, response), (after.position, likely(after.belief))

        response = control_sensitivity(model, state, run.nodes)
        return jax.lax.scan(step, (state, response), controls)[1]

    count = starts.shape[0]
    looked_at = edges
    if isinstance(model, ContactDynamics):
        looked_at = edge_count(model.neighbor_list, run.position.shape[1])
    batch = min(_BATCH, count) if looked_at <= _SMALL_GRAPH else 1
    # A last batch of another size would compile the rollout a second time.
    padded = jnp.pad(starts, (0, -count % batch), mode="edge")
    position, active = jax.lax.map(from_state, padded, batch_size=batch if batch > 1 else None)
    return TrajectoryPrediction(
        position[:count], active[:count], jax.lax.map(likely, carried.prior)
    )


@dataclass(frozen=True, eq=False)
class InferredDetail:
    """The same windows, by beliefs that the motion seen has corrected, and no measured contact."""

    squared_error: np.ndarray
    """[W, H, N] m^2"""
    edge_active: np.ndarray
    """[W, H, E] bool"""
    touch_on_time: np.ndarray
    """[touches] bool"""


@dataclass(frozen=True, eq=False)
class OpenLoopDetail:
    """``W`` windows of ``H`` steps of all runs; nodes and edges padded to the largest run.

    Squared errors are squared distances between predicted and recorded position, 0 in padding.
    """

    dt: float
    """s"""
    run: np.ndarray
    """[W] int: the window's run."""
    start: np.ndarray
    """[W] int: the state it starts from."""
    exists: np.ndarray
    """[W, N] bool: False for padding."""
    moves: np.ndarray
    """[W, N] bool: whether a node gets more than 1 mm away from where it was at the start."""
    squared_error: np.ndarray
    """[W, H, N] m^2: of the model, its beliefs corrected by measured contacts up to the start."""
    squared_error_unmeasured: np.ndarray
    """[W, H, N] m^2: of the model, without measured contacts."""
    constant_velocity: np.ndarray
    """[W, H, N] m^2: of no forces."""
    frozen_contact: np.ndarray | None
    """[W, H, N] m^2: of true masses and the contacts of the window's first state."""
    contact: np.ndarray | None
    """[W, H+1, E] bool: true contacts. None: not recorded in every run."""
    edge_active: np.ndarray
    """[W, H, E] bool: predicted contacts of each step."""
    edge_active_unmeasured: np.ndarray
    """[W, H, E] bool"""
    edge_exists: np.ndarray
    """[W, E] bool: False for padding."""
    touch_on_time: np.ndarray
    """[touches] bool: of all touches in all runs, those predicted for their very step."""
    touch_on_time_unmeasured: np.ndarray
    """[touches] bool"""
    inferred: InferredDetail | None = None
    """None: contacts were not to be inferred."""
    contact_changes: np.ndarray | None = field(init=False)
    """[W] bool: whether any contact begins or ends within the window."""

    def __post_init__(self) -> None:
        changes = None
        if self.contact is not None:
            changes = np.any(self.contact != self.contact[:, :1], axis=(1, 2))
        object.__setattr__(self, "contact_changes", changes)

    @property
    def horizon(self) -> np.ndarray:
        """[H] s: time from a window's start to each of its steps' ends."""
        return self.dt * np.arange(1, self.squared_error.shape[1] + 1)

    def rmse(self, squared_error: np.ndarray, windows: np.ndarray | None = None) -> float | None:
        """m: root mean square of one of the errors above over nodes, steps and windows.

        ``windows``: [W] bool, or [W, N] bool to choose nodes too; default all. None where nothing
        is chosen; infinite where a prediction is not finite.
        """
        chosen = self._chosen(windows)
        count = int(chosen.sum()) * squared_error.shape[1]
        if count == 0:
            return None
        total = np.sum(squared_error.sum(axis=1, dtype=np.float64), where=chosen)
        return float(np.sqrt(total / count))

    def rmse_by_step(
        self, squared_error: np.ndarray, windows: np.ndarray | None = None
    ) -> np.ndarray:
        """[H] m: the same for each step ahead, to be drawn over `horizon`; NaN where nothing is."""
        chosen = self._chosen(windows)
        if not chosen.any():
            return np.full(squared_error.shape[1], np.nan)
        total = np.sum(squared_error, axis=(0, 2), where=chosen[:, None], dtype=np.float64)
        return np.sqrt(total / int(chosen.sum()))

    def rmse_by_window(self, squared_error: np.ndarray) -> np.ndarray:
        """[W] m: over the nodes and steps of each window."""
        count = self.exists.sum(axis=1) * squared_error.shape[1]
        return np.sqrt(squared_error.sum(axis=(1, 2), dtype=np.float64) / count)

    def _chosen(self, windows: np.ndarray | None) -> np.ndarray:
        if windows is None:
            return self.exists
        return self.exists & (windows if windows.ndim == 2 else windows[:, None])


_MOVES_M = 1e-3


def trajectory_detail(
    lists: ReallocatingModel[StepModel],
    dataset: Dataset,
    number: int,
    steps: int,
    sensor: ContactSensor,
    reported: np.ndarray | None,
    motion_noise: MotionNoise | None = None,
) -> OpenLoopDetail:
    """The windows of run ``number``, which must have at least ``steps`` steps.

    ``reported``: [T+1, N, N] bool, what a contact sensor said; None: contacts are known of no run.
    ``motion_noise``: by which contacts are inferred; None: they are not.
    Arrays are padded to the dataset's largest run, so that all runs share one compiled function.
    """
    run = dataset.trajectories[number]
    count = run.scene.node_count
    nodes = _capacity(dataset)
    starts = run.steps - steps + 1
    bare = replace(run, contact=None)
    unmeasured = _predicted(lists, dataset, bare, steps, sensor)
    inferred = None
    if motion_noise is not None:
        # Motion is judged over all pairs.
        inferred = _from_every_state(lists.given, dataset, bare, steps, sensor, motion_noise)
    measured = unmeasured
    if reported is not None:
        measured = _predicted(lists, dataset, replace(run, contact=reported), steps, sensor)

    recorded = _windows(run.position, steps)
    exists = np.broadcast_to(np.arange(nodes) < count, (starts, nodes))
    pairs = pair_indices(nodes)
    travel = np.linalg.norm(recorded - recorded[:, :1], axis=-1).max(axis=1)
    frozen = frozen_contact(run, steps) if reported is not None else None
    contact = _contact(run, nodes) if reported is not None else None
    touches = np.zeros((run.steps, len(pairs)), dtype=bool)
    if contact is not None:
        touches = contact[1:] & ~contact[:-1]

    def error(predicted: np.ndarray) -> np.ndarray:
        squared = np.sum((predicted[:starts, :, :count] - recorded[:, 1:]) ** 2, axis=-1)
        squared = np.where(np.isfinite(squared), squared, np.inf)
        return np.pad(squared, ((0, 0), (0, 0), (0, nodes - count)))

    return OpenLoopDetail(
        dt=dataset.dt,
        run=np.full(starts, number),
        start=np.arange(starts),
        exists=exists,
        moves=np.pad(travel > _MOVES_M, ((0, 0), (0, nodes - count))),
        squared_error=error(np.asarray(measured.position, np.float64)),
        squared_error_unmeasured=error(np.asarray(unmeasured.position, np.float64)),
        constant_velocity=error(constant_velocity(run, steps)),
        frozen_contact=None if frozen is None else error(frozen),
        contact=None if contact is None else _windows(contact, steps),
        edge_active=np.asarray(measured.edge_active)[:starts],
        edge_active_unmeasured=np.asarray(unmeasured.edge_active)[:starts],
        edge_exists=np.logical_and(exists[:, pairs[:, 0]], exists[:, pairs[:, 1]]),
        touch_on_time=np.asarray(measured.coming_active)[: run.steps][touches],
        touch_on_time_unmeasured=np.asarray(unmeasured.coming_active)[: run.steps][touches],
        inferred=None
        if inferred is None
        else InferredDetail(
            squared_error=error(np.asarray(inferred.position, np.float64)),
            edge_active=np.asarray(inferred.edge_active)[:starts],
            touch_on_time=np.asarray(inferred.coming_active)[: run.steps][touches],
        ),
    )


def concatenated_details(parts: Sequence[OpenLoopDetail]) -> OpenLoopDetail:
    """The windows of several runs, one after the other."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    inferred = [part.inferred for part in parts if part.inferred is not None]

    known = all(part.contact is not None for part in parts)
    frozen = all(part.frozen_contact is not None for part in parts)
    return OpenLoopDetail(
        dt=parts[0].dt,
        run=joined("run"),
        start=joined("start"),
        exists=joined("exists"),
        moves=joined("moves"),
        squared_error=joined("squared_error"),
        squared_error_unmeasured=joined("squared_error_unmeasured"),
        constant_velocity=joined("constant_velocity"),
        frozen_contact=joined("frozen_contact") if frozen else None,
        contact=joined("contact") if known else None,
        edge_active=joined("edge_active"),
        edge_active_unmeasured=joined("edge_active_unmeasured"),
        edge_exists=joined("edge_exists"),
        touch_on_time=joined("touch_on_time"),
        touch_on_time_unmeasured=joined("touch_on_time_unmeasured"),
        inferred=InferredDetail(
            squared_error=np.concatenate([part.squared_error for part in inferred]),
            edge_active=np.concatenate([part.edge_active for part in inferred]),
            touch_on_time=np.concatenate([part.touch_on_time for part in inferred]),
        )
        if inferred
        else None,
    )


def _predicted(
    lists: ReallocatingModel[StepModel],
    dataset: Dataset,
    run: Trajectory,
    steps: int,
    sensor: ContactSensor,
) -> TrajectoryPrediction:
    starts, count = run.steps - steps + 1, run.scene.node_count

    def finite(found: TrajectoryPrediction) -> bool:
        return bool(jnp.all(jnp.isfinite(found.position[:starts, :, :count])))

    return lists.reallocate_on_overflow(
        lambda model: _from_every_state(model, dataset, run, steps, sensor, None), finite
    )


def _from_every_state(
    model: StepModel,
    dataset: Dataset,
    run: Trajectory,
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None,
) -> TrajectoryPrediction:
    longest = max(each.steps for each in dataset)
    batch = pad_trajectories((run,), _capacity(dataset), longest)
    padded = on_device(batch.at(0), dtype_of(model))
    starts = jnp.arange(longest - steps + 1)
    return predict_trajectory(model, padded, starts, steps, sensor, motion_noise)


def _capacity(dataset: Dataset) -> int:
    """Nodes of the largest run; at least two, because nothing is made for a graph without edges."""
    return max(2, *(run.scene.node_count for run in dataset))


def _windows(per_state: np.ndarray, steps: int) -> np.ndarray:
    """[S, H+1, …], a view of [T+1, …]."""
    view = np.lib.stride_tricks.sliding_window_view(per_state, steps + 1, axis=0)
    return np.moveaxis(view, -1, 1)


def _contact(run: Trajectory, nodes: int) -> np.ndarray:
    """[T+1, E] bool, padded to ``nodes``."""
    pairs = pair_indices(run.scene.node_count)
    contact = np.zeros((run.steps + 1, nodes * (nodes - 1) // 2), dtype=bool)
    if run.contact is not None:
        contact[:, : len(pairs)] = run.contact[:, pairs[:, 0], pairs[:, 1]]
    return contact
