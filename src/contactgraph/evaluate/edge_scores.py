"""How well predicted contacts match the true ones."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EdgeCounts:
    """How often prediction and truth agree; counts of several runs add up.

    A score is None where there is nothing to divide by.
    """

    hits: int = 0
    false_alarms: int = 0
    misses: int = 0
    total: int = 0
    """All edges in all steps."""

    def __add__(self, other: "EdgeCounts") -> "EdgeCounts":
        return EdgeCounts(
            self.hits + other.hits,
            self.false_alarms + other.false_alarms,
            self.misses + other.misses,
            self.total + other.total,
        )

    @property
    def precision(self) -> float | None:
        """Share of predicted contacts that are true."""
        return _share(self.hits, self.hits + self.false_alarms)

    @property
    def recall(self) -> float | None:
        """Share of true contacts that are predicted."""
        return _share(self.hits, self.hits + self.misses)

    @property
    def f1(self) -> float | None:
        """Harmonic mean of the two."""
        return _share(2 * self.hits, 2 * self.hits + self.false_alarms + self.misses)

    @property
    def accuracy(self) -> float | None:
        """Share of edges and steps that are right."""
        return _share(self.total - self.false_alarms - self.misses, self.total)

    @property
    def false_alarm_rate(self) -> float | None:
        """Share of edges and steps without contact for which contact is predicted."""
        return _share(self.false_alarms, self.total - self.hits - self.misses)


@dataclass(frozen=True)
class EdgeScores:
    """Scores over all edges, steps and windows; None where there is nothing to divide by."""

    precision: float | None
    """Share of predicted contacts that are true."""
    recall: float | None
    """Share of true contacts that are predicted."""
    f1: float | None
    accuracy: float | None
    false_alarm_rate: float | None
    """Share of edges and steps without contact for which contact is predicted."""
    switch_time_error_s: float | None
    """s; see `switch_time_errors`."""
    on_time: float | None
    """Share of touches predicted, from the state just before, for the very step of the touch."""


def edge_scores(
    predicted: np.ndarray,
    contact: np.ndarray,
    exists: np.ndarray,
    touch_on_time: np.ndarray,
    dt: float,
) -> EdgeScores:
    """Scores of ``predicted`` [W, H, E] against ``contact`` [W, H+1, E], both bool.

    Step h of a window leads from its state h to its state h + 1, so its truth is contact in state
    h + 1. ``exists``: [W, E] bool, False for padding. ``touch_on_time``: a bool for every touch.
    """
    counts = edge_counts(predicted, contact[:, 1:], exists)
    late = switch_time_errors(predicted, contact, exists) * dt
    return EdgeScores(
        precision=counts.precision,
        recall=counts.recall,
        f1=counts.f1,
        accuracy=counts.accuracy,
        false_alarm_rate=counts.false_alarm_rate,
        switch_time_error_s=float(late.mean()) if len(late) else None,
        on_time=_share(int(touch_on_time.sum()), len(touch_on_time)),
    )


def edge_counts(predicted: np.ndarray, true: np.ndarray, exists: np.ndarray) -> EdgeCounts:
    """Counts of ``predicted`` against ``true``, both [W, H, E] bool, where ``exists`` [W, E]."""
    return EdgeCounts(
        hits=_count(predicted & true, exists),
        false_alarms=_count(predicted & ~true, exists),
        misses=_count(~predicted & true, exists),
        total=int(exists.sum()) * predicted.shape[1],
    )


def switch_time_errors(
    predicted: np.ndarray, contact: np.ndarray, exists: np.ndarray
) -> np.ndarray:
    """[onsets] steps, at least 0, between the predicted and the true onset of contact.

    One entry for every window and edge that is not in contact in the window's first state and is
    later: the steps between the first true contact and the first predicted one in that window.
    Where none is predicted, the error is all that remains of the window from the true onset on.
    """
    true = contact[:, 1:]
    onset = exists & ~contact[:, 0] & true.any(axis=1)
    actual = true.argmax(axis=1)
    foreseen = np.where(predicted.any(axis=1), predicted.argmax(axis=1), predicted.shape[1])
    return np.abs(foreseen - actual)[onset]


def _count(found: np.ndarray, exists: np.ndarray) -> int:
    return int((found.sum(axis=1) * exists).sum())


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
