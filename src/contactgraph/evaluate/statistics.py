"""Sums, confidence intervals of measured shares and errors, and numbers for JSON."""

import math
from dataclasses import fields
from typing import Any, Self

import numpy as np

from contactgraph.data import InvalidInputError


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval for a share: inside [0, 1] and not empty even for 0 or all successes.

    Raises `InvalidInputError` where there are no trials, or more successes than trials.
    """
    from scipy.stats import binomtest  # slow to import

    if trials < 1:
        raise InvalidInputError(f"trials must be at least 1, found {trials}")
    if not 0 <= successes <= trials:
        raise InvalidInputError(f"successes must be 0 to {trials}, found {successes}")
    interval = binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


class Sums:
    """Base of a dataclass whose fields add up over trajectories; None where one is not known."""

    def __add__(self, other: Self) -> Self:
        found: Any = self
        pairs = ((getattr(each, field.name) for each in (self, other)) for field in fields(found))
        return type(self)(
            *(None if one is None or more is None else one + more for one, more in pairs)
        )


DRAWS = 2000
"""Of resampled episodes."""


def moving_errors(
    squared: np.ndarray, bodies: np.ndarray, episode: np.ndarray
) -> dict[str, float | list[float | None] | None]:
    """Statistics, m, of position errors over the bodies that move in windows; none if none does.

    ``squared``: [W] m^2, mean over a window's steps, summed over its bodies that move, of which
    there are ``bodies`` [W]. ``rmse`` is their root mean square, ``mean`` the mean of the root mean
    squares of single windows, which few large errors cannot decide. ``…_interval``: the 95 %
    between percentiles of 2,000 draws of episodes, with replacement (Efron 1979); ``episode`` [W]
    is a window's. None: an error is not finite.
    """
    moves = bodies > 0
    if not moves.any():
        return {}
    squared, bodies, episode = squared[moves], bodies[moves], episode[moves]
    rows = np.stack([squared, bodies, np.sqrt(squared / bodies), moves[moves]])
    sums = np.stack([rows[:, episode == each].sum(axis=1) for each in np.unique(episode)])
    draws = np.random.default_rng(0).integers(len(sums), size=(DRAWS, len(sums)))
    drawn = np.concatenate([sums.sum(axis=0)[None], sums[draws].sum(axis=1)])
    found: dict[str, float | list[float | None] | None] = {}
    values = {"rmse": np.sqrt(drawn[:, 0] / drawn[:, 1]), "mean": drawn[:, 2] / drawn[:, 3]}
    for name, each in values.items():
        ends = np.quantile(each[1:], (0.025, 0.975), method="inverted_cdf")
        found[name] = finite_or_none(float(each[0]))
        found[f"{name}_interval"] = [finite_or_none(end) for end in ends.tolist()]
    return found


def finite_or_none(value: float | None) -> float | None:
    """None for a number that is not finite, which JSON has no word for."""
    return value if value is not None and math.isfinite(value) else None


def number_or_word(value: float | None) -> float | str | None:
    """A number for JSON: the word ``infinite`` for infinity, None for what is not known."""
    if value is None or math.isnan(value):
        return None
    return value if math.isfinite(value) else "infinite"
