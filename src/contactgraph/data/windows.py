"""Which stretches of the runs a batch is drawn from, and how often each."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.events import event_steps
from contactgraph.data.padding import PaddedRuns


@dataclass(frozen=True, eq=False)
class Windows:
    """All ``W`` windows of ``length`` real steps, from state ``start`` to ``start + length``."""

    run: np.ndarray
    """[W] int."""
    start: np.ndarray
    """[W] int: first step."""
    probability: np.ndarray
    """[W] with which to draw each; sums to 1."""
    has_event: np.ndarray
    """[W] bool: whether a velocity jumps within it."""
    length: int
    """Steps in a window."""


def window_weights(padded: PaddedRuns, window_length: int, event_fraction: float = 0.6) -> Windows:
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
    run, start = np.nonzero(complete)
    eventful = np.asarray(_windowed(event_steps(padded), window_length).any(axis=-1))
    has_event = eventful[run, start]
    events, others = int(has_event.sum()), int((~has_event).sum())
    if events and others:
        probability = np.where(has_event, event_fraction / events, (1 - event_fraction) / others)
    else:
        probability = np.full(len(run), 1.0 / len(run))
    return Windows(run, start, probability, has_event, window_length)


def _windowed(per_step: np.ndarray, length: int) -> np.ndarray:
    """[R, T - length + 1, length], a view."""
    return np.lib.stride_tricks.sliding_window_view(per_step, length, axis=1)
