"""Scores of inferred masses."""

import numpy as np
import pytest

from contactgraph.evaluate.mass_scores import mass_numbers


def test_numbers_of_known_errors():
    errors = np.array([[0.1, 0.1], [-0.1, 0.01], [0.0, 0.2]])
    found = mass_numbers(errors)
    assert found["mass_error_median"] == pytest.approx(np.expm1(0.1))
    assert found["mass_interval_coverage"] == pytest.approx(2 / 3)


@pytest.mark.parametrize("errors", [None, np.zeros((0, 2))])
def test_without_masses_no_number_is_known(errors):
    assert set(mass_numbers(errors).values()) == {None}
