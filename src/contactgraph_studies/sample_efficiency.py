"""How much more data one model needs for the error that another one has."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DataRatio:
    """The answer, or why there is none."""

    ratio: float | None
    """Runs needed, over the runs of the other. None: not reached, or not known."""
    reached: bool | None
    """Whether the error is reached at all; None where it is not known."""


def data_ratio(
    sizes: Sequence[int], errors: Sequence[float], reference_runs: int, reference_error: float
) -> DataRatio:
    """How many runs it takes to come down to ``reference_error``, over ``reference_runs``.

    ``errors`` of the models trained on ``sizes`` runs, in ascending order. Between two sizes the
    error is taken to be straight in log-log; the first crossing counts. An error that is there
    with the fewest runs gives a ratio that is an upper bound.
    """
    known = [
        (size, error)
        for size, error in zip(sizes, errors, strict=True)
        if not math.isnan(error) and error > 0.0
    ]
    if not known or not reference_error > 0.0 or math.isinf(reference_error):
        return DataRatio(None, None)
    for place, (size, error) in enumerate(known):
        if error > reference_error:
            continue
        if place == 0 or math.isinf(known[place - 1][1]):
            return DataRatio(size / reference_runs, True)
        before_size, before = known[place - 1]
        share = np.log(before / reference_error) / np.log(before / error)
        runs = math.exp(np.log(before_size) + share * np.log(size / before_size))
        return DataRatio(runs / reference_runs, True)
    return DataRatio(None, False)
