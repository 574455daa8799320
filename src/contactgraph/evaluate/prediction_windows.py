"""Predictions from every recorded state, beside the recorded trajectories, window by window."""

from collections.abc import Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from contactgraph.data import (
    Dataset,
    edge_id,
    generalized_coordinates,
    moving_bodies,
    pair_indices,
)
from contactgraph.data.turns import turn_between, turned_on
from contactgraph.evaluate.baselines import Baseline, sliding_windows
from contactgraph.evaluate.calibration import Calibration, belief_calibration
from contactgraph.evaluate.edge_scores import edge_counts
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
from contactgraph.model.scene import trajectory_for
from contactgraph.policies.sensor_faults import SensorFault


def trajectory_detail(
    lists: ReallocatingModel[StepModel],
    dataset: Dataset,
    index: int,
    steps: int,
    sensor: ContactSensor,
    faults: SensorFault,
    baselines: Mapping[str, Baseline],
    motion_noise: MotionNoise | None = None,
    last: bool = False,
) -> OpenLoopDetail:
    """The windows of trajectory ``index``, which must have at least ``steps`` steps.

    ``last``: of its last window alone; scores of single steps are of the steps in it.
    ``faults`` corrupts its contacts, where they are recorded. ``baselines`` are compared with the
    same windows. ``motion_noise``: beliefs are also corrected by motion. Arrays are padded to the
    dataset's largest trajectory, so that all share one compiled function.
    """
    trajectory, longest = dataset.trajectories[index], max(each.steps for each in dataset)
    scene, turn_length = trajectory.scene, turn_length_of(lists.given)
    count, dimension = scene.node_count, scene.dimension
    # At least two nodes, because a graph without edges is not supported.
    capacity = max(2, *(each.scene.node_count for each in dataset))
    first = trajectory.steps - steps if last else 0
    starts = trajectory.steps - steps + 1 - first

    def padded(of_nodes: np.ndarray) -> np.ndarray:
        """[..., N] for the capacity."""
        return np.pad(of_nodes, [(0, 0)] * (of_nodes.ndim - 1) + [(0, capacity - count)])

    recorded = sliding_windows(trajectory.position[first:], steps + 1)
    poses, rates = generalized_coordinates(
        1.0,
        trajectory.position,
        trajectory.velocity,
        trajectory.orientation,
        trajectory.angular_velocity,
    )
    angles = sliding_windows(poses[first:, ..., dimension:], steps + 1)
    rate = rates[first : first + starts, None, ..., dimension:]
    one, other = pair_indices(capacity).T
    exists = np.broadcast_to(np.arange(capacity) < count, (starts, capacity))
    edge_exists = exists[:, one] & exists[:, other]
    # What pins join need not be inferred.
    edge_exists[:, edge_id(*np.sort(scene.pins, axis=1).T)] = False
    contact = np.zeros((trajectory.steps + 1 - first, len(one)), dtype=bool)
    reported, labelled = None, edge_exists[:1] & (trajectory.contact is not None)
    if trajectory.contact is not None:
        reported, own = faults.reported(trajectory.contact, scene, index), pair_indices(count)
        contact[:, : len(own)] = trajectory.contact[first:, own[:, 0], own[:, 1]]

    def error(predicted: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            squared = np.sum((predicted[:starts, :, :count] - recorded[:, 1:]) ** 2, axis=-1)
        return padded(np.where(np.isfinite(squared), squared, np.inf))

    def angle_error(predicted: np.ndarray) -> np.ndarray:
        return padded(np.nan_to_num(turn_between(predicted, angles[:, 1:]) ** 2))

    def turned_over(last: np.ndarray) -> np.ndarray:
        """Of the last angles ``[W, N, …]`` of all windows."""
        return padded(turn_between(last, angles[:, 0]) > TURNED_OVER_RAD)

    def calibrated(belief: np.ndarray, state: int) -> Calibration:
        """Of beliefs [S, E] about the steps that lead to the windows' state ``state``, and on."""
        return belief_calibration(np.where(labelled, belief, np.nan), contact[state:])

    def windows(contacts: np.ndarray | None, noise: MotionNoise | None) -> WindowPredictions:
        """The predictions by beliefs that these contacts and the motion correct."""
        # A report with faults may deny a contact that is recorded as holding.
        corrected = replace(trajectory, contact=contacts, holding=None)

        def predicted(model: StepModel) -> TrajectoryPrediction:
            batch = trajectory_for(model, corrected, capacity, longest)
            # As many for every trajectory.
            all_starts = first + jnp.arange(1 if last else longest - steps + 1)
            return predict_trajectory(model, batch, all_starts, steps, sensor, noise)

        def finite(prediction: TrajectoryPrediction) -> bool:
            return bool(jnp.all(jnp.isfinite(prediction.position[:starts, :, :count])))

        # The likelihood of motion is computed over all pairs, without neighbor lists.
        with_lists = lists.reallocate_on_overflow
        found = predicted(lists.given) if noise is not None else with_lists(predicted, finite)
        made = np.asarray(found.now_belief)[first + 1 : trajectory.steps + 1] > 0.5
        coming = np.asarray(found.next_belief)[first : trajectory.steps]
        ahead = np.asarray(found.last_belief)[:starts]
        # A body that only the recording brings near enough counts, too: its belief is 0.
        ahead = np.where(np.isnan(ahead) & np.isfinite(coming[steps - 1 :]), 0.0, ahead)
        position = np.asarray(found.position, np.float64)
        turned = over = None
        if turn_length is not None:
            angle = position[:starts, :, :count, dimension:] / turn_length
            turned, over = angle_error(angle), turned_over(angle[:, -1])
        return WindowPredictions(
            squared_error=error(position[..., :dimension]),
            squared_angle=turned,
            turned_over=over,
            edge_active=np.asarray(found.edge_active)[:starts],
            now=edge_counts(made[None], contact[None, 1:], labelled),
            next_step=calibrated(coming, 1),
            last_step=calibrated(ahead, steps),
            mass_errors=mass_errors(lists.given, trajectory, found.masses),
            pin_gap=largest_pin_gaps(scene, position[:starts], turn_length),
        )

    unmeasured = windows(None, None)
    inferred = None if motion_noise is None else windows(None, motion_noise)
    measured = unmeasured if inferred is None else inferred
    if reported is not None:
        measured = windows(reported, motion_noise)
    compared = {
        name: None if (found := baseline(trajectory, steps)) is None else found[first:]
        for name, baseline in baselines.items()
    }
    turns = {
        name: None if found is None else found[..., dimension:] for name, found in compared.items()
    }
    elapsed = scene.dt * np.arange(1, steps + 1)[:, None, None]
    turns["constant_velocity"] = turned_on(angles[:, :1], elapsed * np.nan_to_num(rate))
    return OpenLoopDetail(
        dt=dataset.dt,
        trajectory=np.full(starts, index),
        start=np.arange(first, first + starts),
        exists=exists,
        moves=padded(moving_bodies(recorded) & ~scene.static),
        contact=None if reported is None else sliding_windows(contact, steps + 1),
        edge_exists=edge_exists,
        measured=measured,
        unmeasured=unmeasured,
        inferred=inferred,
        baselines={
            name: None if found is None else error(found[..., :dimension])
            for name, found in compared.items()
        },
        turns=padded(np.any(turn_between(angles, angles[:, :1]) > TURNS_RAD, axis=1)),
        turned_over=turned_over(angles[:, -1]),
        baseline_angles={
            name: None if turn is None or not turn.size else angle_error(turn)
            for name, turn in turns.items()
        },
    )
