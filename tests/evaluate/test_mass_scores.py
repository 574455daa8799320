"""Scores of inferred masses."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from contactgraph.evaluate.metrics import mass_scores


def scores(errors: np.ndarray | None) -> dict[str, float | None]:
    unread = cast(Any, None)
    return mass_scores(unread, cast(Any, SimpleNamespace(mass_errors=errors)))


def test_numbers_of_known_errors():
    found = scores(np.array([[0.1, 0.1], [-0.1, 0.01], [0.0, 0.2]]))
    assert found["mass_error_median"] == pytest.approx(np.expm1(0.1))
    assert found["mass_interval_coverage"] == pytest.approx(2 / 3)


@pytest.mark.parametrize("errors", [None, np.zeros((0, 2))])
def test_without_masses_no_number_is_known(errors):
    assert set(scores(errors).values()) == {None}
