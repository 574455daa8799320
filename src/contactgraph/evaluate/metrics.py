"""Metrics of open-loop predictions: named numbers of the recorded windows and one prediction.

The keys of JSON are made of the names of both, see `json_key`.
"""

import enum
import re
from collections.abc import Callable, Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np

from contactgraph.evaluate.edge_scores import edge_counts, switch_time_errors
from contactgraph.evaluate.prediction_windows import Prediction, RecordedWindows
from contactgraph.evaluate.statistics import finite_or_none, moving_errors, number_or_word

MODEL = "n_step"
"""The model's prediction by beliefs that measured contacts, where recorded, and the observed
motion, if requested, have corrected up to a window's start."""
UNMEASURED = "n_step_unmeasured"
"""The model's prediction by beliefs that nothing has corrected."""
INFERRED = "n_step_inferred"
"""The model's prediction by beliefs that motion alone has corrected."""
ORACLE = "frozen_contact"
"""The baseline that knows masses and contacts; no verdict depends on it."""
BASELINES = ("constant_velocity", "standing_still", ORACLE, "least_squares", "gnn")
_OF_MODEL = MODEL, UNMEASURED, INFERRED
_TIE = 1e-3
"""Relative difference of two errors up to which neither is better; rounding is far below it."""
_INTERVAL = 0.9
"""Probability of the intervals of masses whose coverage is measured."""


class Verdict(enum.StrEnum):
    """A model's error over moving bodies against the baselines known there, without the oracle."""

    better_than_all = "better than all"
    better_than_constant_velocity = "better than constant velocity"
    no_better = "no better"


def position_errors(windows: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """Root mean square position errors over windows, steps and bodies, m.

    Over all bodies by default; ``_moving``: over those that move in a window; ``_free``,
    ``_contact``: over windows without and with a change of contact.
    """
    changes = windows.contact_changes
    chosen = {
        "_moving": windows.moves,
        "": windows.exists,
        "_free": None if changes is None else ~changes,
        "_contact": changes,
    }
    return {
        f"n_step_rmse{subset}_m": None
        if those is None
        else windows.rmse(prediction.squared_error, those)
        for subset, those in chosen.items()
    }


def moving_intervals(windows: RecordedWindows, prediction: Prediction) -> dict[str, Any]:
    """`moving_errors`, by the names of its statistics."""
    found = moving_errors(
        np.sum(prediction.squared_error.mean(axis=1), axis=1, where=windows.moves),
        windows.moves.sum(axis=1),
        windows.trajectory,
    )
    return {f"n_step_{name}_moving_m": value for name, value in found.items() if name != "rmse"}


def errors_by_type(
    windows: RecordedWindows, prediction: Prediction
) -> dict[str, dict[str, float | None]]:
    """The error over moving bodies, m, of each node type."""
    types = np.full(windows.moves.shape, "", object)
    for row, index in enumerate(windows.trajectory):
        types[row, : len(windows.node_types[index])] = windows.node_types[index]
    squared = prediction.squared_error
    errors = {
        name: finite_or_none(windows.rmse(squared, windows.moves & (types == name)))
        for name in sorted({name for each in windows.node_types for name in each})
    }
    return {"n_step_rmse_moving_by_type_m": errors}


def errors_by_run(
    windows: RecordedWindows, prediction: Prediction
) -> dict[str, list[float | str | None]]:
    """The error over moving bodies, m, of each trajectory, or the word ``infinite``."""
    of_run = ((windows.trajectory == run)[:, None] for run in range(len(windows.node_types)))
    errors = [windows.rmse(prediction.squared_error, windows.moves & each) for each in of_run]
    return {"n_step_rmse_moving_by_run_m": list(map(number_or_word, errors))}


def diverged_windows(_: RecordedWindows, prediction: Prediction) -> dict[str, int]:
    """Windows with a position that is not finite; one of them makes the errors infinite."""
    finite = np.isfinite(prediction.squared_error).all(axis=(1, 2))
    return {"diverged_windows": int((~finite).sum())}


def rest_drift(windows: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """m: the largest position error over the windows in which no body moves, if there are any."""
    at_rest = prediction.squared_error[~windows.moves.any(axis=1)]
    return {"rest_drift_m": float(np.sqrt(at_rest.max())) if at_rest.size else None}


def angle_errors(windows: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """Root mean square error of the angle, rad, over bodies that turn in a window, and steps."""
    squared = prediction.squared_angle
    return {"angle_rmse_rad": None if squared is None else windows.rmse(squared, windows.turns)}


def turned_over(windows: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """Share of windows at whose end as many bodies as recorded have turned over, such as dominoes
    that have fallen; None where none does."""
    found, share = prediction.turned_over, None
    if found is not None and windows.turned_over.any():
        share = float(np.mean(found.sum(axis=1) == windows.turned_over.sum(axis=1)))
    return {"turned_over_accuracy": share}


def pin_drift(_: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """m: the largest distance between the two points of a pin in any window, if there are any."""
    gap = np.zeros(0) if prediction.pin_gap is None else prediction.pin_gap
    return {"pin_drift_m": max(gap[~np.isnan(gap)].tolist(), default=None)}


def edge_scores(windows: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """Scores of predicted edges over the steps of all windows, see `EdgeCounts`.

    ``switch_time_error_s`` is the mean of `switch_time_errors`. ``edge_…_now`` are of the beliefs
    about the step just made, corrected by what was observed after it, against the label of the
    state that it reached, in every state but a trajectory's first.
    """
    active, contact, exists = prediction.edge_active, windows.contact, windows.edge_exists
    counts = now = late = None
    if active is not None and contact is not None:
        counts, now = edge_counts(active, contact[:, 1:], exists), prediction.now
        steps_late = switch_time_errors(active, contact, exists)
        late = windows.dt * float(steps_late.mean()) if len(steps_late) else None
    names = "precision", "recall", "f1", "accuracy"
    return {
        **{f"edge_{name}": getattr(counts, name, None) for name in (*names, "false_alarm_rate")},
        **{f"edge_{name}_now": getattr(now, name, None) for name in names},
        "switch_time_error_s": late,
    }


def calibration_scores(_: RecordedWindows, prediction: Prediction) -> dict[str, Any]:
    """Scores of the beliefs' probabilities, see `Calibration`.

    They are of the beliefs about the step after every state, predicted from it; ``_ahead``: about
    the last step of every window, predicted from its start. Only edges within the model's cutoff
    count: beyond it, beliefs are 0 by construction, which would flatter the numbers.
    """
    return {
        f"{name}{ahead}": getattr(found, score, None)
        for ahead, found in (("", prediction.next_step), ("_ahead", prediction.last_step))
        for name, score in (
            ("calibration_error", "expected_error"),
            ("brier_score", "brier_score"),
            ("log_score", "log_score"),
            ("reliability", "reliability"),
        )
    }


def mass_scores(_: RecordedWindows, prediction: Prediction) -> dict[str, float | None]:
    """Relative errors of masses after one contact, and the coverage of their 90 % intervals."""
    names, errors = ("error_median", "error_p90", "interval_coverage"), prediction.mass_errors
    if errors is None or not len(errors):
        return dict.fromkeys(f"mass_{name}" for name in names)
    relative = np.expm1(np.abs(errors[:, 0]))
    quantile = NormalDist().inv_cdf(0.5 * (1.0 + _INTERVAL))
    covered = np.abs(errors[:, 0]) <= quantile * errors[:, 1]
    values = np.median(relative), np.quantile(relative, 0.9), np.mean(covered)
    return {f"mass_{name}": float(value) for name, value in zip(names, values, strict=True)}


_METRICS: dict[Callable[[RecordedWindows, Prediction], Mapping[str, Any]], tuple[str, ...]] = {
    position_errors: (*_OF_MODEL, *BASELINES),
    moving_intervals: (*_OF_MODEL, *BASELINES),
    errors_by_type: (MODEL, INFERRED),
    errors_by_run: (MODEL,),
    diverged_windows: (MODEL,),
    rest_drift: (MODEL,),
    angle_errors: (*_OF_MODEL, "constant_velocity", "gnn"),
    turned_over: (MODEL,),
    pin_drift: (MODEL,),
    edge_scores: _OF_MODEL,
    calibration_scores: _OF_MODEL,
    mass_scores: (MODEL,),
}
"""The metrics, and which of the model's predictions and the baselines have their keys in JSON;
a prediction of the caller's own has those of all that are known."""
_WHERE_KNOWN = moving_intervals, errors_by_type
"""Metrics whose keys are left out, and not null, where the prediction is not known."""


def json_key(prediction: str, name: str) -> str:
    """The key of a metric's number, of the named prediction.

    Of the model's, ``_unmeasured`` or ``_inferred`` stands before the unit, as in
    ``edge_f1_inferred`` and ``switch_time_error_unmeasured_s``; all others begin with the
    prediction's name, in place of ``n_step`` where the metric's has it, as in ``gnn_rmse_m``.
    """
    if prediction not in _OF_MODEL:
        return f"{prediction}_{name.removeprefix('n_step_')}"
    ending = prediction.removeprefix(MODEL)
    return re.sub(r"(_m|_rad|_s)?$", rf"{ending}\1", name, count=1)


def all_numbers(
    windows: RecordedWindows, predictions: Mapping[str, Prediction | None]
) -> dict[str, Any]:
    """Every metric of every prediction, by `json_key`; the first, `MODEL`, must be known."""
    numbers: dict[str, Any] = {}
    for metric, reported in _METRICS.items():
        names: Mapping[str, Any] = {}
        for which, prediction in predictions.items():
            own = which not in (*_OF_MODEL, *BASELINES)
            if not own and which not in reported:
                continue
            if prediction is not None:
                names = found = metric(windows, prediction)
            elif metric in _WHERE_KNOWN:
                continue
            else:
                found = dict.fromkeys(names)
            always = not own or metric is position_errors
            numbers |= {
                json_key(which, name): value
                for name, value in found.items()
                if always or value is not None
            }
    return numbers


def unbeaten_baselines(errors: Mapping[str, float | None]) -> tuple[str, ...]:
    """The predictions whose error over moving bodies the model's is not below.

    ``errors``: m by prediction; the model's own is ``n_step``, and its others are left out. An
    error that is not known is beaten by none and beats none; `ORACLE` is left out.
    """
    own = errors[MODEL]
    return tuple(
        name
        for name, error in errors.items()
        if name not in (*_OF_MODEL, ORACLE)
        and own is not None
        and error is not None
        and not own < (1.0 - _TIE) * error
    )


def verdict(error: float | None, unbeaten: Sequence[str]) -> Verdict | None:
    """Of the model's error over moving bodies and `unbeaten_baselines`; None: nothing moves."""
    if error is None:
        return None
    if "constant_velocity" in unbeaten:
        return Verdict.no_better
    return Verdict.better_than_constant_velocity if unbeaten else Verdict.better_than_all
