"""Confidence interval of a measured share, and numbers for JSON."""

import math

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


def _checked(confidence: float) -> float:
    if not 0.0 < confidence < 1.0:
        raise InvalidInputError(f"confidence must lie between 0 and 1, found {confidence}")
    return confidence
