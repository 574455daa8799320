"""Runs that belong together, and how they are split for training."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory import Trajectory

Metadata = dict[str, str | int | float | bool]


@dataclass(frozen=True, eq=False)
class Dataset:
    """Runs that one model can be trained on.

    The number of steps and of nodes may differ between runs; degrees of freedom, time step and
    control size may not. Raises `InvalidInputError` naming the first run that disagrees.
    """

    trajectories: tuple[Trajectory, ...]
    metadata: Metadata = field(default_factory=dict)
    """Free-form, about all runs: task, seed, simulator version, …"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        if not self.trajectories:
            raise InvalidInputError("a dataset needs at least one run, found none")
        for number, run in enumerate(self.trajectories):
            _check_agreement("dimension D", number, run.scene.dimension, self.dimension)
            _check_agreement("control size U", number, run.control_size, self.control_size)
            if not np.isclose(run.scene.dt, self.dt, rtol=1e-6, atol=0.0):
                _check_agreement("dt in s", number, run.scene.dt, self.dt)

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    @property
    def dimension(self) -> int:
        """D, degrees of freedom a node."""
        return self.trajectories[0].scene.dimension

    @property
    def control_size(self) -> int:
        """U, the size of the control."""
        return self.trajectories[0].control_size

    @property
    def dt(self) -> float:
        """Time between two steps, s."""
        return self.trajectories[0].scene.dt


def _check_agreement(what: str, number: int, found: float, first: float) -> None:
    if found != first:
        raise InvalidInputError(
            f"run {number}: {what} is {found}, but {first} in run 0; all runs must agree"
        )


def split_by_trajectory(
    dataset: Dataset, held_out_fraction: float, seed: int
) -> tuple[Dataset, Dataset]:
    """Split whole runs into (train, held out), at least one each, in their order in ``dataset``.

    Windows of one run resemble each other, so a split within runs would flatter the error.
    The same seed makes the same split. Raises `InvalidInputError` for fewer than two runs or a
    fraction outside (0, 1).
    """
    if not 0.0 < held_out_fraction < 1.0:
        raise InvalidInputError(
            f"held_out_fraction must lie between 0 and 1, found {held_out_fraction}"
        )
    if len(dataset) < 2:
        raise InvalidInputError("splitting off held-out runs needs at least 2 runs, found 1")
    count = int(np.clip(round(held_out_fraction * len(dataset)), 1, len(dataset) - 1))
    chosen = np.random.default_rng(seed).permutation(len(dataset))[:count]
    held_out = np.isin(np.arange(len(dataset)), chosen)
    runs = dataset.trajectories
    return (
        Dataset(tuple(runs[i] for i in np.flatnonzero(~held_out)), dataset.metadata),
        Dataset(tuple(runs[i] for i in np.flatnonzero(held_out)), dataset.metadata),
    )


def strip_contacts(dataset: Dataset) -> Dataset:
    """The same runs without contact labels, as a sensorless recording would be."""
    return replace(
        dataset, trajectories=tuple(replace(run, contact=None) for run in dataset.trajectories)
    )


def subsample(dataset: Dataset, every: int) -> Dataset:
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
