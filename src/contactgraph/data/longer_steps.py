"""Runs in longer steps: what a robot records at a kilohertz, as a model of 0.01 s sees it."""

from dataclasses import replace

import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory import Trajectory


def with_longer_steps(dataset: Dataset, every: int) -> Dataset:
    """The same runs with every ``every``-th state, and controls averaged in between.

    Two nodes touch in a step if they touched at any of the states that led there. What is left at
    the end of a run and is no whole step is left out.
    Raises `InvalidInputError` where ``every`` is below 1, or a run has fewer steps.
    """
    if every < 1:
        raise InvalidInputError(f"every must be at least 1, found {every}")
    if every == 1:
        return dataset
    return replace(dataset, trajectories=tuple(_longer(run, every) for run in dataset))


def _longer(run: Trajectory, every: int) -> Trajectory:
    steps = run.steps // every
    if steps < 1:
        raise InvalidInputError(f"every must be 1 to {run.steps}, a run's steps, found {every}")
    kept = slice(0, steps * every + 1, every)

    def each(value: np.ndarray | None) -> np.ndarray | None:
        return None if value is None else value[kept]

    contact = run.contact
    if contact is not None:
        since = contact[1 : steps * every + 1].reshape(steps, every, *contact.shape[1:])
        contact = np.concatenate([contact[:1], since.any(axis=1)])
    control = run.control[: steps * every]
    return replace(
        run,
        scene=replace(run.scene, dt=every * run.scene.dt),
        position=run.position[kept],
        velocity=run.velocity[kept],
        control=control.reshape(steps, every, run.control_size).mean(axis=1),
        contact=contact,
        skeleton=each(run.skeleton),
        tracked=each(run.tracked),
        measured_at=each(run.measured_at),
    )
