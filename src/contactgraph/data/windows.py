"""Impacts, found in the motion alone: no contact label is read here.

An impact changes a velocity within one step, by far more than forces do that act over many
steps. So from each body's change of velocity per step [m/s] is taken what its neighbours in time
explain (their median); what is left is compared with the noise of such remainders over the whole
data and with a small part of the speeds that occur.
"""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory_batch import TrajectoryBatch

_NEIGHBOURHOOD = 5
"""Steps whose median counts as smooth motion; odd, and more than twice the length of an impact."""
_NOISE_MULTIPLE = 8.0
"""A jump is larger than this many median remainders."""
_SPEED_FRACTION = 0.025
"""A jump is larger than this part of the typical top speed of a run."""
_REST = 1e-9
"""Top speed, m/s, below which nothing moves in a run."""


def event_steps(padded: TrajectoryBatch) -> np.ndarray:
    """[R, T] bool: the steps ``t -> t + 1`` within which some body's velocity jumps.

    Bodies that nothing actuates are judged by their motion; actuated ones by what the control
    does not explain, with a threshold of their own. Never true in padding. Reads neither
    contacts nor masses.
    """
    floor = _SPEED_FRACTION * _typical_top_speed(padded)
    change = np.diff(padded.velocity, axis=1)
    exists = padded.step_mask[:, :, None] & padded.nodes.mask[:, None, :]
    driven = exists & padded.nodes.actuated[:, None, :]
    change = change - _explained_by_control(padded, change, driven)
    jump = _unlike_neighbours(change, padded.step_mask)
    event = np.zeros(padded.step_mask.shape, dtype=bool)
    for group in (exists & ~driven, driven):
        if not group.any():
            continue
        threshold = max(floor, _NOISE_MULTIPLE * float(np.median(jump[group])))
        event |= np.any(group & (jump > threshold), axis=2)
    return event


def _typical_top_speed(padded: TrajectoryBatch) -> float:
    """Median over the runs that move at all of the fastest speed in a run, m/s."""
    top = np.linalg.norm(padded.velocity, axis=-1).max(axis=(1, 2), initial=0.0)
    moving = top[top > _REST]
    return float(np.median(moving)) if moving.size else 0.0


def _explained_by_control(
    padded: TrajectoryBatch, change: np.ndarray, driven: np.ndarray
) -> np.ndarray:
    """[R, T, N, D] m/s: change of velocity that is linear in the control, by least squares.

    One fit for all actuated bodies; zero for the others.
    """
    explained = np.zeros_like(change)
    run, step, _ = np.nonzero(driven)
    control = padded.control[run, step]
    if control.size:
        gain = np.linalg.lstsq(control, change[driven], rcond=None)[0]
        explained[driven] = control @ gain
    return explained


def _unlike_neighbours(change: np.ndarray, step_mask: np.ndarray) -> np.ndarray:
    """[R, T, N] m/s: how far each change of velocity is from the median of those around it."""
    jump = np.zeros(change.shape[:3])
    margin = _NEIGHBOURHOOD // 2
    for run, steps in enumerate(step_mask.sum(axis=1)):
        own = change[run, :steps]
        around = np.pad(own, [(margin, margin), (0, 0), (0, 0)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(around, _NEIGHBOURHOOD, axis=0)
        jump[run, :steps] = np.linalg.norm(own - np.median(windows, axis=-1), axis=-1)
    return jump


@dataclass(frozen=True, eq=False)
class Windows:
    """All ``W`` windows of ``length`` real steps, from state ``start`` to ``start + length``."""

    trajectory: np.ndarray
    """[W] int."""
    start: np.ndarray
    """[W] int: first step."""
    probability: np.ndarray
    """[W] with which to draw each; sums to 1."""
    has_event: np.ndarray
    """[W] bool: whether a velocity jumps within it."""
    length: int
    """Steps in a window."""


def window_weights(
    padded: TrajectoryBatch, window_length: int, event_fraction: float = 0.6
) -> Windows:
    """Windows, weighted so that ``event_fraction`` of those drawn hold an event.

    Impacts are rare in time (one step in 200), and drawn evenly they would hardly count.
    Where all windows hold an event, or none does, all are equally likely.
    Raises `InvalidInputError` where no run is long enough, or the fraction is outside [0, 1].
    """
    longest = int(padded.step_mask.sum(axis=1).max(initial=0))
    if not 1 <= window_length <= longest:
        raise InvalidInputError(
            f"window_length must be 1 to {longest}, the steps of the longest run, "
            f"found {window_length}"
        )
    if not 0.0 <= event_fraction <= 1.0:
        raise InvalidInputError(f"event_fraction must be 0 to 1, found {event_fraction}")
    complete = np.all(_windowed(padded.step_mask, window_length), axis=-1)
    trajectory, start = np.nonzero(complete)
    eventful = np.asarray(_windowed(event_steps(padded), window_length).any(axis=-1))
    has_event = eventful[trajectory, start]
    events, others = int(has_event.sum()), int((~has_event).sum())
    if events and others:
        probability = np.where(has_event, event_fraction / events, (1 - event_fraction) / others)
    else:
        probability = np.full(len(trajectory), 1.0 / len(trajectory))
    return Windows(trajectory, start, probability, has_event, window_length)


def _windowed(per_step: np.ndarray, length: int) -> np.ndarray:
    """[R, T - length + 1, length], a view."""
    return np.lib.stride_tricks.sliding_window_view(per_step, length, axis=1)
