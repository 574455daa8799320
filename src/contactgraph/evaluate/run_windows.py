"""One run's windows: predictions beside what was recorded."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from contactgraph.data import Dataset, Trajectory, pair_indices
from contactgraph.evaluate.floors import constant_velocity, frozen_contact
from contactgraph.evaluate.open_loop_detail import InferredDetail, OpenLoopDetail
from contactgraph.evaluate.rollouts import RunPrediction, predict_run
from contactgraph.model import ContactSensor, GrowingLists, MotionNoise, StepModel
from contactgraph.model.recording import number_type, recording

_MOVES_M = 1e-3


def detail_of_run(
    lists: GrowingLists[StepModel],
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


def joined_details(parts: Sequence[OpenLoopDetail]) -> OpenLoopDetail:
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
    lists: GrowingLists[StepModel],
    dataset: Dataset,
    run: Trajectory,
    steps: int,
    sensor: ContactSensor,
) -> RunPrediction:
    starts, count = run.steps - steps + 1, run.scene.node_count

    def finite(found: RunPrediction) -> bool:
        return bool(jnp.all(jnp.isfinite(found.position[:starts, :, :count])))

    return lists.until_finite(
        lambda model: _from_every_state(model, dataset, run, steps, sensor, None), finite
    )


def _from_every_state(
    model: StepModel,
    dataset: Dataset,
    run: Trajectory,
    steps: int,
    sensor: ContactSensor,
    motion_noise: MotionNoise | None,
) -> RunPrediction:
    longest = max(each.steps for each in dataset)
    padded = recording(run, longest, _capacity(dataset), number_type(model), True)
    starts = jnp.arange(longest - steps + 1)
    return predict_run(model, padded, starts, steps, sensor, motion_noise)


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
