"""Runs of different length and size in arrays of one shape, with masks that say what is real."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import candidate_pairs, pair_indices


@dataclass(frozen=True, eq=False)
class TrajectoryBatch:
    """``R`` runs padded to common ``T`` and ``N``; padding is zero in numbers, False in masks.

    Real nodes come first on the node axis and real steps first on the time axis.
    """

    position: np.ndarray
    """[R, T+1, N, D] m."""
    velocity: np.ndarray
    """[R, T+1, N, D] m/s."""
    control: np.ndarray
    """[R, T, U] N."""
    node_mask: np.ndarray
    """[R, N] bool: whether the node exists."""
    actuated: np.ndarray
    """[R, N] bool: whether the control acts on the node itself."""
    step_mask: np.ndarray
    """[R, T] bool: whether the step from ``t`` to ``t + 1`` exists."""
    candidate: np.ndarray
    """[R, E] bool: whether the two nodes could touch; edges in `pair_indices`' order."""
    contact: np.ndarray | None
    """[R, T+1, E] bool: whether they do. For evaluation only. None: not recorded in every run."""
    anchor: np.ndarray | None
    """[R, N, D] m: where a node is hinged, NaN where it is not. None: nobody is in any run."""
    dt: float
    """Time between two steps, s."""


def pad_trajectories(dataset: Dataset, node_capacity: int | None = None) -> TrajectoryBatch:
    """Pad all runs to the longest run and to ``node_capacity`` nodes (default: the most in a run).

    Raises `InvalidInputError` where a run has more nodes than the capacity.
    """
    most_nodes = max(run.scene.node_count for run in dataset)
    nodes = most_nodes if node_capacity is None else node_capacity
    if nodes < most_nodes:
        raise InvalidInputError(
            f"node_capacity must be at least {most_nodes}, the most nodes of a run, found {nodes}"
        )
    runs, steps = len(dataset), max(run.steps for run in dataset)
    pairs = pair_indices(nodes)
    labelled = all(run.contact is not None for run in dataset)
    hinges = any(run.scene.has_hinges for run in dataset)
    padded = TrajectoryBatch(
        position=np.zeros((runs, steps + 1, nodes, dataset.dimension)),
        velocity=np.zeros((runs, steps + 1, nodes, dataset.dimension)),
        control=np.zeros((runs, steps, dataset.control_size)),
        node_mask=np.zeros((runs, nodes), dtype=bool),
        actuated=np.zeros((runs, nodes), dtype=bool),
        step_mask=np.zeros((runs, steps), dtype=bool),
        candidate=np.zeros((runs, len(pairs)), dtype=bool),
        contact=np.zeros((runs, steps + 1, len(pairs)), dtype=bool) if labelled else None,
        anchor=np.full((runs, nodes, dataset.dimension), np.nan) if hinges else None,
        dt=dataset.dt,
    )
    for index, run in enumerate(dataset):
        count = run.scene.node_count
        padded.position[index, : run.steps + 1, :count] = run.position
        padded.velocity[index, : run.steps + 1, :count] = run.velocity
        padded.control[index, : run.steps] = run.control
        padded.node_mask[index, :count] = True
        padded.actuated[index, :count] = run.scene.actuated
        if padded.anchor is not None and run.scene.anchor is not None:
            padded.anchor[index, :count] = run.scene.anchor
        padded.step_mask[index, : run.steps] = True
        # A run's own pairs are a prefix of those of the capacity: see `pair_indices`.
        own = pairs[: count * (count - 1) // 2]
        padded.candidate[index] = candidate_pairs(run.scene, nodes)
        if padded.contact is not None and run.contact is not None:
            padded.contact[index, : run.steps + 1, : len(own)] = run.contact[
                :, own[:, 0], own[:, 1]
            ]
    return padded
