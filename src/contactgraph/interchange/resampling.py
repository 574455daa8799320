"""Recordings with gaps and uneven stamps, resampled to even steps.

Positions are interpolated linearly, orientations along the shorter turn. A control holds until the
next one, and its mean over a step is what acted in it.
"""

from collections.abc import Sequence

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.turns import continued_angles, quaternions_of, rotations
from contactgraph.interchange.recording import LARGEST

_EVEN = 0.01
"""Largest error of an even stamp, in steps."""
_LATE = 1.5
"""Intervals since the last measurement, from which on a body is not tracked."""


def is_even(stamps: np.ndarray, dt: float) -> bool:
    """Whether stamps [S] s are steps of ``dt`` s."""
    steps = stamps[0] + dt * np.arange(len(stamps))
    return bool(np.all(np.abs(stamps - steps) <= _EVEN * dt))


def even_times(
    bodies: Sequence[np.ndarray], controls: Sequence[np.ndarray], dt: float, max_gap: float
) -> list[np.ndarray]:
    """Times [T+1] s in steps of ``dt`` at which all bodies are known, at least two each.

    ``bodies`` are the times of each body's measurements, ``controls`` those of commands. Times
    within a gap of more than ``max_gap`` s of any body are left out, and divide the others.
    """
    begin = max(each[0] for each in (*bodies, *controls))
    end = min(each[-1] for each in bodies)
    if begin > end:
        spans = ", ".join(f"{each[0]:.6g} to {each[-1]:.6g}" for each in (*bodies, *controls))
        raise InvalidInputError(
            f"the times of bodies and controls do not overlap, {spans} s: they must be by one clock"
        )
    count = np.floor((end - begin) / dt + _EVEN) + 1.0
    if count * len(bodies) > LARGEST:
        raise InvalidInputError(
            f"times must be less than {LARGEST} steps of {dt:g} s, found {end - begin:g} s"
        )
    times = begin + dt * np.arange(int(count))
    known = np.ones(len(times), dtype=bool)
    for stamps in bodies:
        for gap in np.flatnonzero(np.diff(stamps) > max_gap):
            known &= (times <= stamps[gap] + _EVEN * dt) | (times >= stamps[gap + 1] - _EVEN * dt)
    parts = np.split(times, np.flatnonzero(np.diff(known.astype(int))) + 1)
    return [each for each in parts if len(each) > 1 and known[np.searchsorted(times, each[0])]]


def interpolated(at: np.ndarray, stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[T+1, W] of values [S, W], linearly."""
    return np.stack([np.interp(at, stamps, each) for each in values.T], axis=1)


def interpolated_turns(at: np.ndarray, stamps: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """[T+1, 1 or 4] of orientations [S, 1 or 4]; NaN throughout where fewer than two are known."""
    known = np.isfinite(turns).all(axis=1)
    if known.sum() < 2:
        return np.full((len(at), turns.shape[1]), np.nan)
    stamps, turns = stamps[known], turns[known]
    if turns.shape[1] == 1:
        return interpolated(at, stamps, continued(turns))
    from scipy.spatial.transform import Slerp  # slow to import

    return quaternions_of(Slerp(stamps, rotations(turns))(np.clip(at, stamps[0], stamps[-1])))


def continued(turns: np.ndarray) -> np.ndarray:
    """Orientations [T+1, 1 or 4], whose angles and signs of quaternions continue without jumps."""
    if turns.shape[1] == 1:
        return continued_angles(turns, np.zeros_like(turns), 1.0)
    known, found = np.isfinite(turns).all(axis=1), turns.copy()
    agree = np.sum(turns[known][1:] * turns[known][:-1], axis=1) >= 0.0
    found[known] *= np.cumprod([1.0, *np.where(agree, 1.0, -1.0)])[: known.sum(), None]
    return found


def held_means(at: np.ndarray, stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[T, U]: means over each step between the times ``at`` of values [S, U] that hold on."""
    ends = np.append(stamps, max(at[-1], stamps[-1]) + 1.0)
    total = np.cumsum(np.diff(ends)[:, None] * values, axis=0)
    total = interpolated(at, ends, np.concatenate([np.zeros_like(values[:1]), total]))
    return np.diff(total, axis=0) / np.diff(at)[:, None]


def any_within(at: np.ndarray, stamps: np.ndarray, flags: np.ndarray) -> np.ndarray:
    """[T+1] bool: whether any flag [S] was set within the step that led to each time."""
    count = np.concatenate([[0], np.cumsum(flags)])
    upto = np.searchsorted(stamps, at + _EVEN * (at[1] - at[0]), side="right")
    since = np.maximum(np.minimum(np.concatenate([upto[:1], upto[:-1]]), upto - 1), 0)
    return np.asarray(count[upto] > count[since])


def newest(at: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """[T+1] the newest measurement at each time; the first one before it."""
    found = np.searchsorted(stamps, at + _EVEN * (at[1] - at[0]), side="right") - 1
    return np.asarray(np.maximum(found, 0))


def measured_at(at: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """[T+1] s: the newest of the measurements' times at each time."""
    return np.minimum(stamps[newest(at, stamps)], at)


def is_tracked(at: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """[T+1] bool: whether the newest measurement is no older than those in between usually are."""
    usual = max(float(np.median(np.diff(stamps))), float(at[1] - at[0]))
    return np.asarray(at - measured_at(at, stamps) <= _LATE * usual)
