import itertools
import math

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.evaluate import median_interval, wilson_interval


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


def test_wilson_narrows_with_trials_and_widens_with_confidence():
    assert np.diff(wilson_interval(50, 100)) < np.diff(wilson_interval(5, 10))
    assert np.diff(wilson_interval(5, 10, 0.99)) > np.diff(wilson_interval(5, 10))


def test_wilson_arguments():
    with pytest.raises(InvalidInputError, match="trials must be at least 1, found 0"):
        wilson_interval(0, 0)
    with pytest.raises(InvalidInputError, match="successes must be 0 to 3, found 4"):
        wilson_interval(4, 3)
    with pytest.raises(InvalidInputError, match=r"confidence must lie between 0 and 1, found 95"):
        wilson_interval(1, 3, 95)


@pytest.mark.parametrize(
    # The ranks in tables of the sign test's interval (e.g. Conover, table A3).
    ("count", "rank"),
    [(6, 1), (8, 1), (9, 2), (10, 2), (20, 6), (100, 40)],
)
def test_the_median_lies_between_the_tabulated_order_statistics(count, rank):
    values = np.random.default_rng(0).permutation(np.arange(1.0, count + 1))
    found = median_interval(values)
    assert (found.low, found.high) == (rank, count + 1 - rank)
    assert found.median == (count + 1) / 2 and found.coverage >= 0.95


@pytest.mark.parametrize("count", [1, 2, 5, 6, 9])
def test_coverage_counted_over_all_coin_throws(count):
    found = median_interval(np.arange(1.0, count + 1))
    above = [sum(coins) for coins in itertools.product((0, 1), repeat=count)]
    # The interval of ranks [low, high] holds the median if neither too few nor too many are above.
    holds = [found.low <= heads <= found.high - 1 for heads in above]
    assert found.coverage == pytest.approx(np.mean(holds))


def test_few_values_give_their_range_and_its_name():
    found = median_interval([3.0, 1.0, 2.0])
    assert (found.low, found.median, found.high) == (1.0, 2.0, 3.0)
    assert found.coverage == pytest.approx(0.75)


def test_many_values_do_not_underflow():
    found = median_interval(np.arange(2001.0))
    assert found.median == 1000 and 950 < found.low < 960 and 0.95 <= found.coverage < 0.96


def test_median_arguments():
    with pytest.raises(InvalidInputError, match="values must be at least one finite number"):
        median_interval([])
    with pytest.raises(InvalidInputError, match="values must be at least one finite number"):
        median_interval([1.0, np.nan])
