"""Windows that training draws, weighted so that impacts are not rare.

Impacts are detected from motion alone, without contact labels. An impact changes a velocity within
one step by far more than forces that act over many steps. So the median of the neighbouring steps
is subtracted from each body's velocity change per step [m/s], and the remainder is compared with
the noise of such remainders over all data and with a small part of the occurring speeds.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import Array, TrajectoryBatch

MOVES_M = 1e-3
"""Distance from its first position, m, above which a body counts as moving in a window."""
_NEIGHBOURHOOD = 5
"""Steps whose median counts as smooth motion; odd, and more than twice the length of an impact."""
_NOISE_MULTIPLE = 8.0
"""A jump is larger than this many median remainders."""
_SPEED_FRACTION = 0.025
"""A jump is larger than this part of the typical top speed of a trajectory."""
_REST = 1e-9
"""Top speed, m/s, below which nothing moves in a trajectory."""


@dataclass(frozen=True, eq=False)
class Windows:
    """All ``W`` windows of ``length`` real steps, from state ``start`` to ``start + length``."""

    trajectory: np.ndarray
    """[W] int: index of the trajectory."""
    start: np.ndarray
    """[W] int: first state."""
    probability: np.ndarray
    """[W] of drawing each window; sums to 1."""
    has_event: np.ndarray
    """[W] bool: whether a velocity jumps within the window."""
    length: int
    """Steps in a window."""


def window_weights(
    batch: TrajectoryBatch[np.ndarray], window_length: int, event_fraction: float = 0.6
) -> Windows:
    """Windows with probabilities such that ``event_fraction`` of those drawn hold an event.

    Impacts are rare in time (one step in 200), so uniform sampling would hardly show them. All
    windows are equally likely where every window holds an event, or none does.
    Raises `InvalidInputError` where no trajectory is long enough, or the fraction is outside
    [0, 1].
    """
    step_mask = batch.step_mask
    check_window_length(window_length, int(batch.steps.max(initial=0)))
    if not 0.0 <= event_fraction <= 1.0:
        raise InvalidInputError(f"event_fraction must be 0 to 1, found {event_fraction}")
    trajectory, start = np.nonzero(_windowed(step_mask, window_length).all(axis=-1))
    eventful = np.asarray(_windowed(event_steps(batch), window_length).any(axis=-1))
    has_event = eventful[trajectory, start]
    events, others = int(has_event.sum()), int((~has_event).sum())
    if events and others:
        probability = np.where(has_event, event_fraction / events, (1 - event_fraction) / others)
    else:
        probability = np.full(len(trajectory), 1.0 / len(trajectory))
    return Windows(trajectory, start, probability, has_event, window_length)


def moving_bodies(position: Array) -> Array:
    """[..., N] bool: the bodies that get more than `MOVES_M` away from their first position.

    ``position``: [..., H+1, N, D] m, the states of windows, NumPy or JAX.
    """
    window = cast(Any, position)
    squared_distance = ((window - window[..., :1, :, :]) ** 2).sum(-1)
    return squared_distance.max(-2) > MOVES_M**2


def check_window_length(window_length: int, longest: int) -> None:
    """Raises `InvalidInputError` unless the length is 1 to ``longest``, the most steps."""
    if not 1 <= window_length <= longest:
        raise InvalidInputError(
            f"window_length must be 1 to {longest}, the steps of the longest trajectory, "
            f"found {window_length}"
        )


def event_steps(batch: TrajectoryBatch[np.ndarray]) -> np.ndarray:
    """[R, T] bool: the steps ``t -> t + 1`` within which a body's velocity jumps; not in padding.

    For actuated bodies the part of the motion that is linear in the control is removed first, and
    they have a threshold of their own. Contacts and masses are not read.
    """
    step_mask = batch.step_mask
    least = _SPEED_FRACTION * _typical_top_speed(batch)
    change = np.diff(batch.velocity, axis=1)
    exists = step_mask[:, :, None] & batch.nodes.mask[:, None, :]
    driven = exists & batch.nodes.actuated[:, None, :]
    change = change - _explained_by_control(batch.control, change, driven)
    jump = _difference_from_neighbours(change, batch.steps)
    event = np.zeros(step_mask.shape, dtype=bool)
    for group in (exists & ~driven, driven):
        if group.any():
            threshold = max(least, _NOISE_MULTIPLE * float(np.median(jump[group])))
            event |= np.any(group & (jump > threshold), axis=2)
    return event


def _typical_top_speed(batch: TrajectoryBatch[np.ndarray]) -> float:
    """Median over the trajectories with motion of the highest speed in each, m/s."""
    top = np.linalg.norm(batch.velocity, axis=-1).max(axis=(1, 2), initial=0.0)
    moving = top[top > _REST]
    return float(np.median(moving)) if moving.size else 0.0


def _explained_by_control(
    control: np.ndarray, change: np.ndarray, driven: np.ndarray
) -> np.ndarray:
    """[R, T, N, D] m/s: velocity change that is linear in the control, by least squares.

    One fit serves all actuated bodies; other bodies have zero.
    """
    explained = np.zeros_like(change)
    trajectory, step, _ = np.nonzero(driven)
    applied = control[trajectory, step]
    if applied.size:
        explained[driven] = applied @ np.linalg.lstsq(applied, change[driven], rcond=None)[0]
    return explained


def _difference_from_neighbours(change: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """[R, T, N] m/s: distance of each velocity change from the median of those around it."""
    jump = np.zeros(change.shape[:3])
    margin = _NEIGHBOURHOOD // 2
    for index, count in enumerate(steps):
        own = change[index, :count]
        around = np.pad(own, [(margin, margin), (0, 0), (0, 0)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(around, _NEIGHBOURHOOD, axis=0)
        jump[index, :count] = np.linalg.norm(own - np.median(windows, axis=-1), axis=-1)
    return jump


def _windowed(per_step: np.ndarray, length: int) -> np.ndarray:
    """[R, T - length + 1, length], a view."""
    return np.lib.stride_tricks.sliding_window_view(per_step, length, axis=1)
