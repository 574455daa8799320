"""Impacts, found in the motion alone: no contact label is read here.

An impact changes a velocity within one step, by far more than forces do that act over many
steps. So from each body's change of velocity per step [m/s] is taken what its neighbours in time
explain (their median); what is left is compared with the noise of such remainders over the whole
data and with a small part of the speeds that occur.
"""

import numpy as np

from contactgraph.data.padding import PaddedRuns

_NEIGHBOURHOOD = 5
"""Steps whose median counts as smooth motion; odd, and more than twice the length of an impact."""
_NOISE_MULTIPLE = 8.0
"""A jump is larger than this many median remainders."""
_SPEED_FRACTION = 0.025
"""A jump is larger than this part of the typical top speed of a run."""
_REST = 1e-9
"""Top speed, m/s, below which nothing moves in a run."""


def event_steps(padded: PaddedRuns) -> np.ndarray:
    """[R, T] bool: the steps ``t -> t + 1`` within which some body's velocity jumps.

    Bodies that nothing actuates are judged by their motion; actuated ones by what the control
    does not explain, with a threshold of their own. Never true in padding. Reads neither
    contacts nor masses.
    """
    floor = _SPEED_FRACTION * _typical_top_speed(padded)
    change = np.diff(padded.velocity, axis=1)
    exists = padded.step_mask[:, :, None] & padded.node_mask[:, None, :]
    driven = exists & padded.actuated[:, None, :]
    change = change - _explained_by_control(padded, change, driven)
    jump = _unlike_neighbours(change, padded.step_mask)
    event = np.zeros(padded.step_mask.shape, dtype=bool)
    for group in (exists & ~driven, driven):
        if not group.any():
            continue
        threshold = max(floor, _NOISE_MULTIPLE * float(np.median(jump[group])))
        event |= np.any(group & (jump > threshold), axis=2)
    return event


def _typical_top_speed(padded: PaddedRuns) -> float:
    """Median over the runs that move at all of the fastest speed in a run, m/s."""
    top = np.linalg.norm(padded.velocity, axis=-1).max(axis=(1, 2), initial=0.0)
    moving = top[top > _REST]
    return float(np.median(moving)) if moving.size else 0.0


def _explained_by_control(padded: PaddedRuns, change: np.ndarray, driven: np.ndarray) -> np.ndarray:
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
