"""How sure a measured share or median is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from contactgraph.data import InvalidInputError


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    r"""Wilson's interval for a share: inside [0, 1] and not empty even for 0 or all successes.

    $$ \frac{\hat p + z^2/2n \pm z\sqrt{\hat p(1-\hat p)/n + z^2/4n^2}}{1 + z^2/n},
       \qquad \hat p = \text{successes}/n $$

    Raises `InvalidInputError` where there are no trials, more successes than trials, or the
    confidence is outside (0, 1).
    """
    if trials < 1:
        raise InvalidInputError(f"trials must be at least 1, found {trials}")
    if not 0 <= successes <= trials:
        raise InvalidInputError(f"successes must be 0 to {trials}, found {successes}")
    z = NormalDist().inv_cdf(0.5 + _checked(confidence) / 2.0)
    share, weight = successes / trials, z**2 / trials
    centre = share + weight / 2.0
    spread = math.sqrt(share * (1.0 - share) * weight + weight**2 / 4.0)
    # Clipped because rounding can leave [0, 1] by one in the last place.
    low = max(0.0, (centre - spread) / (1.0 + weight))
    high = min(1.0, (centre + spread) / (1.0 + weight))
    return low, high


@dataclass(frozen=True)
class MedianInterval:
    """A sample's median between two of its values."""

    median: float
    low: float
    high: float
    coverage: float
    """Probability that such an interval holds the true median, whatever the distribution."""


def median_interval(
    values: Sequence[float] | np.ndarray, confidence: float = 0.95
) -> MedianInterval:
    """The median with the narrowest symmetric pair of order statistics of enough coverage.

    Below 6 values (at 95 %) even the whole range covers less than asked for; it is given all the
    same, and `MedianInterval.coverage` says how much it does. Nothing about the distribution is
    assumed, and no random numbers are drawn. Raises `InvalidInputError` where there are no
    values, one is not finite, or the confidence is outside (0, 1).
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64).ravel())
    count = len(ordered)
    if count == 0 or not np.all(np.isfinite(ordered)):
        raise InvalidInputError(f"values must be at least one finite number, found {ordered}")
    tail_wanted = (1.0 - _checked(confidence)) / 2.0
    # The k-th value lies above the median as often as fewer than k of n fair coins show heads.
    # In integers, since 0.5**n vanishes in floating point where n is large.
    heads, rank, tail = 1, 1, 1
    while rank < (count + 1) // 2:
        heads = heads * (count - rank + 1) // rank
        if (tail + heads) / 2**count > tail_wanted:
            break
        tail, rank = tail + heads, rank + 1
    return MedianInterval(
        median=float(np.median(ordered)),
        low=float(ordered[rank - 1]),
        high=float(ordered[count - rank]),
        coverage=1.0 - 2.0 * (tail / 2**count),
    )


def _checked(confidence: float) -> float:
    if not 0.0 < confidence < 1.0:
        raise InvalidInputError(f"confidence must lie between 0 and 1, found {confidence}")
    return confidence
