import math

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.evaluate import wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe (1998) for 81 of 263; the ends for none and all are z^2 / (n + z^2) from 0 and 1.
        (0, 10, 0.0, 0.2775328),
        (10, 10, 0.7224672, 1.0),
        (5, 10, 0.2365931, 0.7634069),
        (81, 263, 0.2553, 0.3662),
        (100, 100, 0.9630065, 1.0),
    ],
)
def test_wilson_against_published_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=6e-5)


def test_wilson_bounds_are_the_shares_that_the_score_test_just_rejects():
    for share in wilson_interval(17, 40):
        z = (17 / 40 - share) / math.sqrt(share * (1 - share) / 40)
        assert abs(z) == pytest.approx(1.959964, abs=1e-5)


def test_wilson_narrows_with_trials():
    assert np.diff(wilson_interval(50, 100)) < np.diff(wilson_interval(5, 10))


def test_wilson_arguments():
    with pytest.raises(InvalidInputError, match="trials must be at least 1, found 0"):
        wilson_interval(0, 0)
    with pytest.raises(InvalidInputError, match="successes must be 0 to 3, found 4"):
        wilson_interval(4, 3)
