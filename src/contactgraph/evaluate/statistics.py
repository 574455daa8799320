"""Confidence intervals of a measured share and of a median."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's interval for a share: inside [0, 1] and not empty even for 0 or all successes.

    Raises `InvalidInputError` where there are no trials, more successes than trials, or the
    confidence is outside (0, 1).
    """
    from scipy.stats import binomtest  # slow to import

    if trials < 1:
        raise InvalidInputError(f"trials must be at least 1, found {trials}")
    if not 0 <= successes <= trials:
        raise InvalidInputError(f"successes must be 0 to {trials}, found {successes}")
    result = binomtest(int(successes), int(trials))
    interval = result.proportion_ci(_checked(confidence), method="wilson")
    return float(interval.low), float(interval.high)


def finite_or_none(value: float | None) -> float | None:
    """None for a number that is not finite, which JSON has no word for."""
    return value if value is not None and math.isfinite(value) else None


def number_or_word(value: float | None) -> float | str | None:
    """A number for JSON: the word ``infinite`` for infinity, None for what is not known."""
    if value is None or math.isnan(value):
        return None
    return value if math.isfinite(value) else "infinite"


@dataclass(frozen=True)
class MedianInterval:
    """A sample's median between two of its values."""

    median: float
    low: float
    high: float
    coverage: float
    """Probability that such an interval contains the true median, for any distribution."""


def median_interval(
    values: Sequence[float] | np.ndarray, confidence: float = 0.95
) -> MedianInterval:
    """The median with the narrowest symmetric pair of order statistics of enough coverage.

    Below 6 values (at 95 %) even the whole range covers less than requested; the range is returned
    with its coverage. Nothing is assumed about the distribution. Raises `InvalidInputError` where
    there are no values, one is not finite, or the confidence is outside (0, 1).
    """
    from scipy.stats import binom  # slow to import

    ordered = np.sort(np.asarray(values, dtype=np.float64).ravel())
    count = len(ordered)
    if count == 0 or not np.all(np.isfinite(ordered)):
        raise InvalidInputError(f"values must be at least one finite number, found {ordered}")
    # The k-th value is above the median with the probability of fewer than k heads in n throws.
    tails = binom.cdf(np.arange((count + 1) // 2), count, 0.5)
    rank = max(1, int(np.sum(tails <= (1.0 - _checked(confidence)) / 2.0)))
    return MedianInterval(
        median=float(np.median(ordered)),
        low=float(ordered[rank - 1]),
        high=float(ordered[count - rank]),
        coverage=float(1.0 - 2.0 * tails[rank - 1]),
    )


def _checked(confidence: float) -> float:
    if not 0.0 < confidence < 1.0:
        raise InvalidInputError(f"confidence must lie between 0 and 1, found {confidence}")
    return confidence
