"""Predictions from every recorded state, beside the recorded trajectories, window by window."""

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from contactgraph.data import (
    Dataset,
    Trajectory,
    edge_id,
    generalized_coordinates,
    moving_bodies,
    pair_indices,
)
from contactgraph.data.turns import turn_between, turned_on
from contactgraph.evaluate.baselines import Baseline
from contactgraph.evaluate.calibration import Calibration, belief_calibration, no_calibration
from contactgraph.evaluate.edge_scores import EdgeCounts, edge_counts
from contactgraph.evaluate.mass_scores import mass_errors
from contactgraph.evaluate.open_loop_detail import (
    TURNED_OVER_RAD,
    TURNS_RAD,
    OpenLoopDetail,
    WindowPredictions,
)
from contactgraph.evaluate.trajectory_prediction import (
    TrajectoryPrediction,
    largest_pin_gaps,
    predict_trajectory,
)
from contactgraph.inference.features import turn_length_of
from contactgraph.large_scenes import ReallocatingModel
from contactgraph.model import ContactSensor, MotionNoise, StepModel
from contactgraph.model.filter import trajectory_for


def trajectory_detail(
    lists: ReallocatingModel[StepModel],
    dataset: Dataset,
    index: int,
    steps: int,
    sensor: ContactSensor,
    reported: np.ndarray | None,
    baselines: Mapping[str, Baseline],
    motion_noise: MotionNoise | None = None,
    last: bool = False,
) -> OpenLoopDetail:
    """The windows of trajectory ``index``, which must have at least ``steps`` steps.

    ``last``: of its last window alone; scores of single steps are of the steps in it.
    ``reported``: [T+1, N, N] bool, reports of a contact sensor; None: contacts were not recorded
    in every trajectory. ``baselines`` are compared with the same windows. ``motion_noise``:
    beliefs are also corrected by motion. Arrays are padded to the dataset's largest trajectory,
    so that all share one compiled function.
    """
    trajectory = dataset.trajectories[index]
    first = trajectory.steps - steps if last else 0
    count, starts = trajectory.scene.node_count, trajectory.steps - steps + 1 - first
    # At least two nodes, because a graph without edges is not supported.
    capacity = max(2, *(each.scene.node_count for each in dataset))
    longest = max(each.steps for each in dataset)
    turn_length = turn_length_of(lists.given)
    pairs = pair_indices(capacity)
    recorded = _windows(trajectory.position[first:], steps)
    contact = None
    touches = np.zeros((trajectory.steps - first, len(pairs)), dtype=bool)
    if reported is not None:
        contact = _edge_contacts(trajectory, len(pairs))[first:]
        touches = contact[1:] & ~contact[:-1]

    def error(predicted: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            squared = np.sum((predicted[:starts, :, :count] - recorded[:, 1:]) ** 2, axis=-1)
        squared = np.where(np.isfinite(squared), squared, np.inf)
        return np.pad(squared, ((0, 0), (0, 0), (0, capacity - count)))

    poses, rates = generalized_coordinates(
        1.0,
        trajectory.position,
        trajectory.velocity,
        trajectory.orientation,
        trajectory.angular_velocity,
    )
    dimension = trajectory.scene.dimension
    angles, rate = _windows(poses[first:, ..., dimension:], steps), rates[first:, ..., dimension:]

    def angle_error(predicted: np.ndarray) -> np.ndarray:
        squared = turn_between(predicted, angles[:, 1:]) ** 2
        return np.pad(np.nan_to_num(squared), ((0, 0), (0, 0), (0, capacity - count)))

    def turned_over(last: np.ndarray) -> np.ndarray:
        """Of the last angles ``[W, N, …]`` of all windows."""
        over = turn_between(last, angles[:, 0]) > TURNED_OVER_RAD
        return np.pad(over, ((0, 0), (0, capacity - count)))

    def predicted(
        model: StepModel, contacts: np.ndarray | None, noise: MotionNoise | None = None
    ) -> TrajectoryPrediction:
        # A report with faults may deny a contact that is recorded as holding.
        known = replace(trajectory, contact=contacts, holding=None)
        padded = trajectory_for(model, known, capacity, longest)
        all_starts = first + jnp.arange(1 if last else longest - steps + 1)
        return predict_trajectory(model, padded, all_starts, steps, sensor, noise)

    def finite(prediction: TrajectoryPrediction) -> bool:
        return bool(jnp.all(jnp.isfinite(prediction.position[:starts, :, :count])))

    def windows(prediction: TrajectoryPrediction) -> WindowPredictions:
        made = np.asarray(prediction.now_belief)[first + 1 : trajectory.steps + 1] > 0.5
        coming = np.asarray(prediction.next_belief)[first : trajectory.steps]
        ahead = np.asarray(prediction.last_belief)[:starts]
        # A body that only the recording brings near enough counts, too: its belief is 0.
        ahead = np.where(np.isnan(ahead) & np.isfinite(coming[steps - 1 :]), 0.0, ahead)
        now = EdgeCounts()
        if contact is not None:
            now = edge_counts(made[None], contact[None, 1:], edge_exists[:1])
        position = np.asarray(prediction.position, np.float64)
        turned = over = None
        if turn_length is not None:
            angle = position[:starts, :, :count, dimension:] / turn_length
            turned, over = angle_error(angle), turned_over(angle[:, -1])
        return WindowPredictions(
            squared_error=error(position[..., :dimension]),
            squared_angle=turned,
            turned_over=over,
            edge_active=np.asarray(prediction.edge_active)[:starts],
            touch_on_time=coming[touches] > 0.5,
            now=now,
            next_step=calibrated(coming, 1),
            last_step=calibrated(ahead, steps),
            mass_errors=mass_errors(lists.given, trajectory, prediction.masses),
            pin_gap=largest_pin_gaps(trajectory.scene, position[:starts], turn_length),
        )

    def calibrated(belief: np.ndarray, state: int) -> Calibration:
        """Of beliefs [S, E] about the steps that lead to the windows' state ``state``, and on."""
        if contact is None:
            return no_calibration()
        return belief_calibration(np.where(edge_exists[:1], belief, np.nan), contact[state:])

    def by_lists(contacts: np.ndarray | None) -> WindowPredictions:
        function = lists.reallocate_on_overflow
        return windows(function(lambda model: predicted(model, contacts), finite))

    def by_motion(contacts: np.ndarray | None) -> WindowPredictions:
        return windows(predicted(lists.given, contacts, motion_noise))

    elapsed = np.arange(1, steps + 1)[:, None, None]
    exists = np.broadcast_to(np.arange(capacity) < count, (starts, capacity))
    edge_exists = np.logical_and(exists[:, pairs[:, 0]], exists[:, pairs[:, 1]])
    # What pins join need not be inferred.
    edge_exists[:, edge_id(*np.sort(trajectory.scene.pins, axis=1).T)] = False
    moves = moving_bodies(recorded) & ~trajectory.scene.static
    unmeasured = by_lists(None)
    # The likelihood of motion is computed over all pairs, without neighbor lists.
    inferred = None if motion_noise is None else by_motion(None)
    if reported is None:
        measured = unmeasured if inferred is None else inferred
    else:
        measured = by_lists(reported) if inferred is None else by_motion(reported)
    compared = {
        name: None if (found := baseline(trajectory, steps)) is None else found[first:]
        for name, baseline in baselines.items()
    }
    drifted = turned_on(
        angles[:, :1], trajectory.scene.dt * elapsed * np.nan_to_num(rate[:starts, None])
    )
    turns = {
        name: None if found is None else found[..., dimension:] for name, found in compared.items()
    } | {"constant_velocity": drifted}
    return OpenLoopDetail(
        dt=dataset.dt,
        trajectory=np.full(starts, index),
        start=np.arange(first, first + starts),
        exists=exists,
        moves=np.pad(moves, ((0, 0), (0, capacity - count))),
        contact=None if contact is None else _windows(contact, steps),
        edge_exists=edge_exists,
        measured=measured,
        unmeasured=unmeasured,
        inferred=inferred,
        baselines={
            name: None if found is None else error(found[..., :dimension])
            for name, found in compared.items()
        },
        turns=np.pad(
            np.any(turn_between(angles, angles[:, :1]) > TURNS_RAD, axis=1),
            ((0, 0), (0, capacity - count)),
        ),
        turned_over=turned_over(angles[:, -1]),
        baseline_angles={
            name: None if turn is None or not turn.size else angle_error(turn)
            for name, turn in turns.items()
        },
    )


def _windows(per_state: np.ndarray, steps: int) -> np.ndarray:
    """[S, H+1, …], a view of [T+1, …]."""
    view = np.lib.stride_tricks.sliding_window_view(per_state, steps + 1, axis=0)
    return np.moveaxis(view, -1, 1)


def _edge_contacts(trajectory: Trajectory, edges: int) -> np.ndarray:
    """[T+1, E] bool: recorded contacts, padded to ``edges``."""
    pairs = pair_indices(trajectory.scene.node_count)
    contact = np.zeros((trajectory.steps + 1, edges), dtype=bool)
    if trajectory.contact is not None:
        contact[:, : len(pairs)] = trajectory.contact[:, pairs[:, 0], pairs[:, 1]]
    return contact
