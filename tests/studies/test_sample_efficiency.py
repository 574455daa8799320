"""How much more data for an equal error, on curves whose answer is known."""

import math

import pytest

from contactgraph_studies.sample_efficiency import data_ratio

SIZES = (10, 20, 40, 80, 160)


def test_a_power_law_is_read_off_exactly() -> None:
    # error = 8 / runs: that of 1/4 cm is reached with 32 runs.
    found = data_ratio(SIZES, [8.0 / size for size in SIZES], 16, 0.25)
    assert found.reached is True
    assert found.ratio == pytest.approx(2.0)


def test_the_first_crossing_counts() -> None:
    found = data_ratio(SIZES, [4.0, 1.0, 3.0, 1.0, 0.5], 10, 2.0)
    assert found.ratio == pytest.approx(math.sqrt(2.0))


def test_never_and_at_once() -> None:
    never = data_ratio(SIZES, [5.0, 4.0, 3.0, 3.0, 2.0], 40, 1.0)
    assert (never.ratio, never.reached) == (None, False)
    at_once = data_ratio(SIZES, [0.5, 0.4, 0.3, 0.3, 0.2], 40, 1.0)
    assert (at_once.ratio, at_once.reached) == (10 / 40, True)


def test_what_is_not_finite_or_not_known() -> None:
    found = data_ratio(SIZES, [math.inf, math.inf, 0.5, 0.4, 0.3], 40, 1.0)
    assert found.ratio == 1.0, "nothing to interpolate from: the size itself"
    assert data_ratio(SIZES, [math.nan] * 5, 40, 1.0).reached is None
    assert data_ratio(SIZES, [1.0] * 5, 40, math.nan).reached is None
    assert data_ratio(SIZES, [1.0] * 5, 40, math.inf).reached is None
