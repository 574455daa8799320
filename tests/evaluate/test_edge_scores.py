import numpy as np
import pytest

from contactgraph.evaluate.edge_scores import edge_counts, switch_time_errors

ON, OFF = True, False


def one_window(predicted, contact):
    """[1, H, 1] and [1, H+1, 1]."""
    shape = (1, -1, 1)
    return np.array(predicted).reshape(shape), np.array(contact).reshape(shape)


@pytest.mark.parametrize(
    ("predicted", "contact", "errors"),
    [
        ([OFF, OFF, ON, ON], [OFF, OFF, OFF, ON, ON], [0]),  # on time
        ([OFF, OFF, OFF, ON], [OFF, OFF, OFF, ON, ON], [1]),  # late
        ([ON, OFF, OFF, OFF], [OFF, OFF, OFF, ON, ON], [2]),  # early, also if it lets go
        ([OFF, OFF, OFF, OFF], [OFF, OFF, OFF, ON, ON], [2]),  # missed: two steps remain
        ([ON, ON, ON, ON], [ON, ON, ON, ON, ON], []),  # no onset
        ([OFF, ON, ON, ON], [ON, OFF, ON, ON, ON], []),  # in contact to begin with
        ([ON, ON, ON, ON], [OFF, OFF, OFF, OFF, OFF], []),  # a false alarm has no true time
        ([OFF, ON, OFF, ON], [OFF, ON, OFF, ON, OFF], [1]),  # the first onset counts
    ],
)
def test_switch_times(predicted, contact, errors):
    found = switch_time_errors(*one_window(predicted, contact), np.array([[True]]))
    assert found.tolist() == errors


def test_scores_against_a_loop_and_without_padding():
    rng = np.random.default_rng(0)
    predicted, contact = rng.random((7, 4, 3)) < 0.5, rng.random((7, 4, 3)) < 0.3
    exists = rng.random((7, 3)) < 0.7
    cells = {"tp": 0, "fp": 0, "fn": 0, "tn": 0}
    for w, h, e in np.ndindex(7, 4, 3):
        if exists[w, e]:
            guess, truth = predicted[w, h, e], contact[w, h, e]
            cells[("t" if guess == truth else "f") + ("p" if guess else "n")] += 1
    found = edge_counts(predicted, contact, exists)
    tp, fp, fn, tn = cells.values()
    assert found.precision == pytest.approx(tp / (tp + fp))
    assert found.recall == pytest.approx(tp / (tp + fn))
    assert found.f1 == pytest.approx(tp / (tp + (fp + fn) / 2))
    assert found.accuracy == pytest.approx((tp + tn) / (tp + fp + fn + tn))


def test_unknown_values_are_none():
    never = np.zeros((1, 2, 1), bool)
    found = edge_counts(never, never, np.array([[True]]))
    assert found.accuracy == 1.0
    assert found.precision is found.recall is found.f1 is None
    assert edge_counts(never, never, np.array([[False]])).accuracy is None
