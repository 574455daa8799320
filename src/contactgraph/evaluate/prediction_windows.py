"""Windows of recorded trajectories, and predictions of them beside what was recorded."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    edge_id,
    generalized_coordinates,
    moving_bodies,
    pair_indices,
)
from contactgraph.data.turns import turn_between
from contactgraph.evaluate.baselines import Predictor, sliding_windows
from contactgraph.evaluate.calibration import Calibration, belief_calibration
from contactgraph.evaluate.edge_scores import EdgeCounts, edge_counts
from contactgraph.evaluate.trajectory_prediction import (
    TrajectoryPrediction,
    largest_pin_gaps,
    mass_errors,
    predict_trajectory,
)
from contactgraph.inference.features import turn_length_of
from contactgraph.large_scenes import ReallocatingModel
from contactgraph.model import ContactSensor, MotionNoise, StepModel
from contactgraph.model.scene import trajectory_for

_TURNS_RAD = np.deg2rad(0.5)
"""Angle from the one at a window's start that a body must reach to count as turning."""
_TURNED_OVER_RAD = np.pi / 4.0
"""Angle from the one at a window's start by which a body that has fallen has turned."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One prediction of all windows, beside what was recorded; None: it has no such quantity.

    A prediction of contacts has beliefs, too. They are empty where contacts were not recorded.
    """

    squared_error: np.ndarray
    """[W, H, N] m^2: squared distance between predicted and recorded position, 0 in padding."""
    squared_angle: np.ndarray | None = None
    """[W, H, N] rad^2: of the angle, 0 where it is not recorded."""
    turned_over: np.ndarray | None = None
    """[W, N] bool: whether a body has turned by more than `_TURNED_OVER_RAD` since the window's
    start, at its end."""
    pin_gap: np.ndarray | None = None
    """[W] m: the largest `pin_gaps` in the window; NaN without pins."""
    edge_active: np.ndarray | None = None
    """[W, H, E] bool: predicted contacts of each step."""
    now: EdgeCounts | None = None
    """Beliefs about the step just made against the label of the state reached, over the steps of
    whole trajectories."""
    next_step: Calibration | None = None
    """Beliefs about the step after each state of whole trajectories, predicted from that state."""
    last_step: Calibration | None = None
    """The same for the last step of every window, predicted from its start."""
    mass_errors: np.ndarray | None = None
    """See `mass_errors`."""


@dataclass(frozen=True, eq=False)
class RecordedWindows:
    """``W`` windows of ``H`` steps of all trajectories; nodes and edges padded to the largest."""

    dt: float
    """s"""
    node_types: Sequence[Sequence[str]]
    """Of every trajectory, by its index, also of those that are too short for a window."""
    trajectory: np.ndarray
    """[W] int: index of the window's trajectory."""
    start: np.ndarray
    """[W] int: the state it starts from."""
    exists: np.ndarray
    """[W, N] bool: False for padding."""
    moves: np.ndarray
    """[W, N] bool: whether a body that is not static gets more than `MOVES_M` away from its
    position at the start."""
    turns: np.ndarray
    """[W, N] bool: whether a body gets more than `_TURNS_RAD` away from its angle at the start."""
    turned_over: np.ndarray
    """[W, N] bool: as that of `Prediction`, of what was recorded."""
    contact: np.ndarray | None
    """[W, H+1, E] bool: true contacts. None: not recorded in every trajectory."""
    edge_exists: np.ndarray
    """[W, E] bool: False for padding."""

    @property
    def contact_changes(self) -> np.ndarray | None:
        """[W] bool: whether any contact begins or ends within the window. None: not recorded."""
        if self.contact is None:
            return None
        return np.any(self.contact != self.contact[:, :1], axis=(1, 2))

    def rmse(self, squared_error: np.ndarray, windows: np.ndarray | None = None) -> float | None:
        """m, or rad: root mean square of a prediction's errors over nodes, steps and windows.

        ``windows``: [W] bool, or [W, N] bool to choose nodes too; default all. None where nothing
        is chosen; infinite where a prediction is not finite.
        """
        chosen = self.exists
        if windows is not None:
            chosen = chosen & (windows if windows.ndim == 2 else windows[:, None])
        count = int(chosen.sum()) * squared_error.shape[1]
        if count == 0:
            return None
        total = np.sum(squared_error.sum(axis=1, dtype=np.float64), where=chosen)
        return float(np.sqrt(total / count))


class TrajectoryWindows:
    """The windows of trajectory ``index`` of a dataset, which must have at least ``steps`` steps.

    ``last``: its last window alone; scores of single steps are of the steps in it. Arrays are
    padded to the dataset's largest trajectory, so that all share one compiled function.
    """

    def __init__(self, dataset: Dataset, index: int, steps: int, last: bool = False) -> None:
        self.trajectory = trajectory = dataset.trajectories[index]
        self.steps = steps
        self.longest = max(each.steps for each in dataset)
        # At least two nodes, because a graph without edges is not supported.
        self.capacity = max(2, *(each.scene.node_count for each in dataset))
        self.first = first = trajectory.steps - steps if last else 0
        self.starts = trajectory.steps - steps + 1 - first
        self.most_starts = 1 if last else self.longest - steps + 1
        """As many for every trajectory."""
        scene = trajectory.scene
        self.position = sliding_windows(trajectory.position[first:], steps + 1)
        turning = trajectory.orientation, trajectory.angular_velocity
        poses, _ = generalized_coordinates(1.0, trajectory.position, trajectory.velocity, *turning)
        self.angle = sliding_windows(poses[first:, ..., scene.dimension :], steps + 1)
        one, other = pair_indices(self.capacity).T
        exists = np.arange(self.capacity) < scene.node_count
        edge_exists = exists[one] & exists[other]
        # What pins join need not be inferred.
        edge_exists[edge_id(*np.sort(scene.pins, axis=1).T)] = False
        self.contact = np.zeros((trajectory.steps + 1 - first, len(one)), dtype=bool)
        if trajectory.contact is not None:
            own = pair_indices(scene.node_count)
            self.contact[:, : len(own)] = trajectory.contact[first:, own[:, 0], own[:, 1]]
        unlabelled = trajectory.contact is None
        self.recorded = RecordedWindows(
            dt=scene.dt,
            node_types=tuple(each.scene.node_type for each in dataset),
            trajectory=np.full(self.starts, index),
            start=first + np.arange(self.starts),
            exists=np.tile(exists, (self.starts, 1)),
            moves=self._padded(moving_bodies(self.position) & ~scene.static),
            turns=self._padded(np.any(self._turned(self.angle, _TURNS_RAD), axis=1)),
            turned_over=self._padded(self._turned(self.angle[:, -1:], _TURNED_OVER_RAD)[:, 0]),
            contact=None if unlabelled else sliding_windows(self.contact, steps + 1),
            edge_exists=np.tile(edge_exists, (self.starts, 1)),
        )
        """What was recorded in them."""

    def predicted(self, name: str, predictor: Predictor) -> Prediction | None:
        """The prediction of a function. Raises `InvalidInputError` where its shape is wrong."""
        found, scene = predictor(self.trajectory, self.steps), self.trajectory.scene
        if found is None:
            return None
        poses = np.asarray(found)
        shape = self.first + self.starts, self.steps, scene.node_count
        sizes = scene.dimension, scene.dimension + self.angle.shape[-1]
        if poses.shape[:-1] != shape or poses.shape[-1] not in sizes:
            raise InvalidInputError(
                f"prediction {name!r} must have the shape {(*shape, sizes[0])}, or with angles "
                f"{(*shape, sizes[1])}, found {poses.shape}"
            )
        return self.compared(poses[self.first :])

    def predicted_by(
        self,
        lists: ReallocatingModel[StepModel],
        contacts: np.ndarray | None,
        sensor: ContactSensor,
        noise: MotionNoise | None,
    ) -> Prediction:
        """A model's, by beliefs that these contacts and, with a ``noise``, the motion correct."""
        # A report with faults may deny a contact that is recorded as holding.
        corrected = replace(self.trajectory, contact=contacts, holding=None)
        starts, count = self.starts, self.trajectory.scene.node_count

        def predicted(model: StepModel) -> TrajectoryPrediction:
            batch = trajectory_for(model, corrected, self.capacity, self.longest)
            all_starts = self.first + jnp.arange(self.most_starts)
            return predict_trajectory(model, batch, all_starts, self.steps, sensor, noise)

        def finite(prediction: TrajectoryPrediction) -> bool:
            return bool(jnp.all(jnp.isfinite(prediction.position[:starts, :, :count])))

        # The likelihood of motion is computed over all pairs, without neighbor lists.
        with_lists = lists.reallocate_on_overflow
        found = predicted(lists.given) if noise is not None else with_lists(predicted, finite)
        poses = np.array(found.position[:starts, :, :count], np.float64)
        if (turn_length := turn_length_of(lists.given)) is not None:
            poses[..., self.trajectory.scene.dimension :] /= turn_length
        errors = mass_errors(lists.given, self.trajectory, found.masses)
        return replace(self._with_beliefs(self.compared(poses), found), mass_errors=errors)

    def compared(self, poses: np.ndarray) -> Prediction:
        """Positions [S, H, N, D] m beside the recorded ones, and angles, rad, where ``poses`` have
        further columns."""
        scene = self.trajectory.scene
        place, angle = np.split(poses, [scene.dimension], axis=-1)
        with np.errstate(over="ignore", invalid="ignore"):
            squared = np.sum((place - self.position[:, 1:]) ** 2, axis=-1)
        turned = over = gap = None
        if angle.shape[-1]:
            turned = self._padded(np.nan_to_num(turn_between(angle, self.angle[:, 1:]) ** 2))
            over = self._padded(self._turned(angle[:, -1:], _TURNED_OVER_RAD)[:, 0])
            gap = largest_pin_gaps(scene, poses)
        return Prediction(
            squared_error=self._padded(np.where(np.isfinite(squared), squared, np.inf)),
            squared_angle=turned,
            turned_over=over,
            pin_gap=gap,
        )

    def _with_beliefs(self, prediction: Prediction, found: TrajectoryPrediction) -> Prediction:
        first, starts, steps = self.first, self.starts, self.trajectory.steps
        labelled = self.recorded.edge_exists[:1] & (self.trajectory.contact is not None)

        def calibrated(belief: np.ndarray, state: int) -> Calibration:
            """Of beliefs [S, E] about the steps that lead to state ``state`` and those after."""
            return belief_calibration(np.where(labelled, belief, np.nan), self.contact[state:])

        made = np.asarray(found.now_belief)[first + 1 : steps + 1] > 0.5
        coming = np.asarray(found.next_belief)[first:steps]
        ahead = np.asarray(found.last_belief)[:starts]
        # A body that only the recording brings near enough counts, too: its belief is 0.
        ahead = np.where(np.isnan(ahead) & np.isfinite(coming[self.steps - 1 :]), 0.0, ahead)
        return replace(
            prediction,
            edge_active=np.asarray(found.edge_active)[:starts],
            now=edge_counts(made[None], self.contact[None, 1:], labelled),
            next_step=calibrated(coming, 1),
            last_step=calibrated(ahead, self.steps),
        )

    def _turned(self, angles: np.ndarray, least: float) -> np.ndarray:
        """[W, H, N] bool: whether bodies have turned by more than ``least`` rad since the start."""
        return np.asarray(turn_between(angles, self.angle[:, :1]) > least)

    def _padded(self, of_nodes: np.ndarray) -> np.ndarray:
        """[..., N] for the capacity."""
        missing = self.capacity - of_nodes.shape[-1]
        return np.pad(of_nodes, [(0, 0)] * (of_nodes.ndim - 1) + [(0, missing)])
