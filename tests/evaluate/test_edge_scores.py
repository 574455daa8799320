import numpy as np
import pytest

from contactgraph.evaluate.edge_scores import edge_scores, switch_time_errors

ON, OFF = True, False
NOTHING = np.zeros(0, dtype=bool)


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


def test_step_h_is_compared_with_contact_in_state_h_plus_1():
    found = edge_scores(
        *one_window([OFF, ON, ON], [ON, OFF, ON, ON]), np.array([[True]]), NOTHING, 0.1
    )
    assert (
        found.counts.precision,
        found.counts.recall,
        found.counts.f1,
        found.counts.accuracy,
    ) == (1.0, 1.0, 1.0, 1.0)


def test_scores_against_a_loop_and_without_padding():
    rng = np.random.default_rng(0)
    predicted, contact = rng.random((7, 4, 3)) < 0.5, rng.random((7, 5, 3)) < 0.3
    exists = rng.random((7, 3)) < 0.7
    cells = {"tp": 0, "fp": 0, "fn": 0, "tn": 0}
    for w, h, e in np.ndindex(7, 4, 3):
        if exists[w, e]:
            guess, truth = predicted[w, h, e], contact[w, h + 1, e]
            cells[("t" if guess == truth else "f") + ("p" if guess else "n")] += 1
    found = edge_scores(predicted, contact, exists, np.array([True, False, True, True]), 0.1)
    tp, fp, fn, tn = cells.values()
    assert found.counts.precision == pytest.approx(tp / (tp + fp))
    assert found.counts.recall == pytest.approx(tp / (tp + fn))
    assert found.counts.f1 == pytest.approx(tp / (tp + (fp + fn) / 2))
    assert found.counts.accuracy == pytest.approx((tp + tn) / (tp + fp + fn + tn))
    assert found.on_time == 0.75
    assert found.switch_time_error_s == pytest.approx(
        0.1 * switch_time_errors(predicted, contact, exists).mean()
    )


def test_unknown_values_are_none():
    never = one_window([OFF, OFF], [OFF, OFF, OFF])
    found = edge_scores(*never, np.array([[True]]), NOTHING, 0.1)
    assert found.counts.accuracy == 1.0
    assert found.counts.precision is found.counts.recall is found.counts.f1 is None
    assert found.switch_time_error_s is found.on_time is None
    assert edge_scores(*never, np.array([[False]]), NOTHING, 0.1).counts.accuracy is None
