"""Calibration of beliefs: how often edges are active that are believed so with a probability.

Only edges within the model's cutoff count. Beyond it a belief is 0 by construction and nearly
always right, which would flatter every number.
"""

from dataclasses import dataclass

import numpy as np

from contactgraph.evaluate.statistics import Sums

BINS = 10
"""Bins of probability, of equal width."""
_MIN_PROBABILITY = 1e-6
"""Least probability of what happened in the log score, so that one edge cannot make it infinite."""


@dataclass(frozen=True, eq=False)
class Calibration(Sums):
    """Sums over beliefs and labels; those of several trajectories add up.

    A score is None where no belief was counted.
    """

    count: np.ndarray
    """[10] beliefs in each bin of probability, of equal width."""
    belief: np.ndarray
    """[10] sum of the beliefs in each bin."""
    active: np.ndarray
    """[10] labels that are true, of the beliefs in each bin."""
    squared_error: float
    """Sum of the squared differences between beliefs and labels, 0 or 1."""
    log_loss: float
    """Sum of -ln of the probability of each label, which counts as at least 1e-6."""

    @property
    def total(self) -> int:
        """All beliefs counted."""
        return int(self.count.sum())

    @property
    def expected_error(self) -> float | None:
        """Expected calibration error: mean over beliefs of the difference, in their bin, between
        mean belief and share of true labels."""
        return self._mean(float(np.abs(self.belief - self.active).sum()))

    @property
    def brier_score(self) -> float | None:
        """Mean squared error of the beliefs; 0 is best."""
        return self._mean(self.squared_error)

    @property
    def log_score(self) -> float | None:
        """Mean negative logarithm of the probability of the labels; 0 is best."""
        return self._mean(self.log_loss)

    @property
    def reliability(self) -> list[list[float | int | None]] | None:
        """[10, 3]: count, mean belief and share of true labels of each bin; None without beliefs,
        and for both shares of an empty bin."""
        if not self.total:
            return None
        return [
            [int(count), *((belief / count, active / count) if count else (None, None))]
            for count, belief, active in zip(
                self.count.tolist(), self.belief.tolist(), self.active.tolist(), strict=True
            )
        ]

    def _mean(self, total: float) -> float | None:
        return total / self.total if self.total else None


def belief_calibration(belief: np.ndarray, label: np.ndarray) -> Calibration:
    """Calibration of probabilities against bool labels of the same shape; NaN does not count."""
    counted = np.isfinite(belief)
    probability = np.clip(np.asarray(belief, np.float64)[counted], 0.0, 1.0)
    true = np.asarray(label, np.float64)[counted]
    chosen = np.minimum((BINS * probability).astype(int), BINS - 1)
    happened = np.where(true > 0, probability, 1.0 - probability)
    return Calibration(
        count=np.bincount(chosen, minlength=BINS),
        belief=np.bincount(chosen, probability, BINS),
        active=np.bincount(chosen, true, BINS),
        squared_error=float(np.sum((probability - true) ** 2)),
        log_loss=float(-np.sum(np.log(np.maximum(happened, _MIN_PROBABILITY)))),
    )


def no_calibration() -> Calibration:
    """That of no beliefs."""
    return belief_calibration(np.zeros(0), np.zeros(0, bool))
