"""Numbers of an open-loop evaluation by their JSON keys, and the verdict on the model."""

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from contactgraph.evaluate.calibration import Calibration
from contactgraph.evaluate.edge_scores import edge_counts, switch_time_errors
from contactgraph.evaluate.open_loop_detail import OpenLoopDetail
from contactgraph.evaluate.statistics import finite_or_none, moving_errors, number_or_word

ORACLE = "frozen_contact"
"""The baseline that knows masses and contacts; no verdict depends on it."""
_TIE = 1e-3
"""Relative difference of two errors up to which neither is better; rounding is far below it."""


class Verdict(enum.StrEnum):
    """A model's error over moving bodies against the baselines known there, without the oracle."""

    better_than_all = "better than all"
    better_than_constant_velocity = "better than constant velocity"
    no_better = "no better"


@dataclass(frozen=True)
class OpenLoopMetrics:
    """The results of `evaluate_open_loop`."""

    runs: int
    """Number of trajectories."""
    windows: int
    n_steps: int
    """Steps in a window."""
    diverged_windows: int
    """Windows with a prediction that is not finite; one of them makes the errors infinite."""
    numbers: Mapping[str, float | None]
    """Errors and scores by their JSON keys: see `error_numbers`, `edge_numbers` and
    `calibration_numbers`. None: the data do not determine a number."""
    unbeaten: tuple[str, ...]
    """Baselines that the model is not better than: see `unbeaten_baselines`."""
    detail: OpenLoopDetail = field(repr=False, compare=False)
    """Every window on its own; not part of `to_json`."""
    by_type: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    """See `numbers_by_type`."""
    by_run: Sequence[float | str | None] = ()
    """See `errors_by_run`."""
    extra: Mapping[str, float | None] = field(default_factory=dict, repr=False, compare=False)
    """Metrics of the caller's own, by name."""

    def __getitem__(self, name: str) -> float | None:
        """The error or score with this JSON key."""
        return self.numbers[name]

    @property
    def verdict(self) -> Verdict | None:
        """None: nothing moves."""
        if self.numbers["n_step_rmse_moving_m"] is None:
            return None
        if "constant_velocity" in self.unbeaten:
            return Verdict.no_better
        return Verdict.better_than_constant_velocity if self.unbeaten else Verdict.better_than_all

    def to_json(self) -> dict[str, Any]:
        """All results by name; None for those that are not known or not finite.

        Besides `numbers`, `error_intervals`, and under the keys ``reliability…``, with the endings
        of `calibration_numbers`, `Calibration.reliability`.
        """
        numbers = {**self.numbers, **self.extra}
        finite = {name: finite_or_none(value) for name, value in numbers.items()}
        counts = ("runs", "windows", "n_steps", "diverged_windows")
        verdict = None if self.verdict is None else self.verdict.value
        reliability = {
            f"reliability{ending}": None if found is None else found.reliability
            for ending, found in _calibrations(self.detail).items()
        }
        named = {name: getattr(self, name) for name in counts}
        by_run = {"n_step_rmse_moving_by_run_m": list(self.by_run)}
        found = {**error_intervals(self.detail), **finite, **reliability, **self.by_type}
        return {**found, **by_run, "verdict": verdict, **named}


def error_numbers(detail: OpenLoopDetail) -> dict[str, float | None]:
    """Root mean square position errors over windows, steps and bodies, m.

    The keys are ``{prediction}_rmse{bodies and windows}{beliefs}_m``. Predictions are ``n_step``,
    the model's, and the baselines'. Over all bodies by default; ``_moving``: over those that move
    in a window; ``_free``, ``_contact``: over windows without and with a change of contact. By
    beliefs that measured contacts, where recorded, and the observed motion, if requested, have
    corrected, by default; ``_unmeasured``: by nothing; ``_inferred``: by motion alone.
    """
    changes = detail.contact_changes
    chosen = {
        "_moving": detail.moves,
        "": detail.exists,
        "_free": None if changes is None else ~changes,
        "_contact": changes,
    }
    return {
        f"{name}_rmse{subset}{beliefs}_m": None
        if error is None or windows is None
        else detail.rmse(error, windows)
        for subset, windows in chosen.items()
        for (name, beliefs), error in _squared_errors(detail).items()
    }


def error_intervals(detail: OpenLoopDetail) -> dict[str, float | list[float | None] | None]:
    """`moving_errors` of the predictions of `error_numbers` that are known.

    The keys are ``{prediction}_{statistic}_moving{beliefs}_m``.
    """
    return {
        f"{name}_{statistic}_moving{beliefs}_m": value
        for (name, beliefs), error in _squared_errors(detail).items()
        if error is not None
        for statistic, value in moving_errors(
            np.sum(error.mean(axis=1), axis=1, where=detail.moves),
            detail.moves.sum(axis=1),
            detail.trajectory,
        ).items()
    }


def _squared_errors(detail: OpenLoopDetail) -> dict[tuple[str, str], np.ndarray | None]:
    """[W, H, N] m^2, by prediction and beliefs."""
    return {
        ("n_step", ""): detail.measured.squared_error,
        **{(name, ""): error for name, error in detail.baselines.items()},
        ("n_step", "_unmeasured"): detail.unmeasured.squared_error,
        ("n_step", "_inferred"): None if detail.inferred is None else detail.inferred.squared_error,
    }


def angle_numbers(detail: OpenLoopDetail) -> dict[str, float | None]:
    """Root mean square errors of the angle, rad, over bodies that turn in a window, and its steps.

    ``angle_rmse`` is the model's, with the endings of `error_numbers`. None: the model has no
    angle, or nothing turns.
    """
    found = {
        "angle_rmse": detail.measured.squared_angle,
        "angle_rmse_unmeasured": detail.unmeasured.squared_angle,
        "angle_rmse_inferred": None if detail.inferred is None else detail.inferred.squared_angle,
        "constant_velocity_angle_rmse": detail.baseline_angles["constant_velocity"],
        "gnn_angle_rmse": detail.baseline_angles["gnn"],
    }
    return {
        f"{name}_rad": None if squared is None else detail.rmse(squared, detail.turns)
        for name, squared in found.items()
    }


def turned_over_accuracy(detail: OpenLoopDetail) -> float | None:
    """Share of windows at whose end as many bodies as recorded have turned over, such as dominoes
    that have fallen; see `WindowPredictions.turned_over`.

    Beliefs are corrected as by default in `error_numbers`. None: the model has no angle, or no body
    turns over.
    """
    found = detail.measured.turned_over
    if found is None or not detail.turned_over.any():
        return None
    return float(np.mean(found.sum(axis=1) == detail.turned_over.sum(axis=1)))


def rest_drift(detail: OpenLoopDetail) -> float | None:
    """m: the largest position error over the windows in which no body moves; None: there are none.

    Beliefs are corrected as by default in `error_numbers`.
    """
    at_rest = detail.measured.squared_error[~detail.moves.any(axis=1)]
    return float(np.sqrt(at_rest.max())) if at_rest.size else None


def pin_drift(detail: OpenLoopDetail) -> float | None:
    """m: the largest distance between the two points of a pin in any prediction; None: there are no
    pins, or the model predicts no angles."""
    gap = detail.measured.pin_gap[~np.isnan(detail.measured.pin_gap)]
    return float(gap.max()) if gap.size else None


def numbers_by_type(
    detail: OpenLoopDetail, node_types: Sequence[Sequence[str]]
) -> dict[str, dict[str, float | None]]:
    """The model's errors over moving bodies, m, of each node type; as in `error_numbers`.

    ``node_types``: of every trajectory, by its index.
    """
    types = np.full(detail.moves.shape, "", object)
    for row, index in enumerate(detail.trajectory):
        types[row, : len(node_types[index])] = node_types[index]
    beliefs = {"": detail.measured, "_inferred": detail.inferred}
    return {
        f"n_step_rmse_moving_by_type{ending}_m": {
            name: finite_or_none(detail.rmse(found.squared_error, detail.moves & (types == name)))
            for name in sorted({name for each in node_types for name in each})
        }
        for ending, found in beliefs.items()
        if found is not None
    }


def errors_by_run(detail: OpenLoopDetail, runs: int) -> list[float | str | None]:
    """m, of each trajectory: the model's error over moving bodies, or the word ``infinite``."""
    squared = detail.measured.squared_error
    return [
        number_or_word(detail.rmse(squared, detail.moves & (detail.trajectory == run)[:, None]))
        for run in range(runs)
    ]


def edge_numbers(detail: OpenLoopDetail) -> dict[str, float | None]:
    """Scores of predicted edges over the steps of all windows, see `EdgeCounts`.

    ``switch_time_error_s`` is the mean of `switch_time_errors`. ``edge_…_now`` are of the beliefs
    about the step just made, corrected by what was observed after it, against the label of the
    state that it reached, in every state but a trajectory's first. ``_unmeasured`` and
    ``_inferred`` as in `error_numbers`.
    """
    numbers: dict[str, float | None] = {}
    for beliefs in ("", "_unmeasured", "_inferred"):
        found = getattr(detail, beliefs.removeprefix("_") or "measured")
        counts = now = late = None
        if detail.contact is not None and found is not None:
            edges, exists, now = found.edge_active, detail.edge_exists, found.now
            counts = edge_counts(edges, detail.contact[:, 1:], exists)
            steps_late = switch_time_errors(edges, detail.contact, exists)
            late = detail.dt * float(steps_late.mean()) if len(steps_late) else None
        for name in ("precision", "recall", "f1", "accuracy", "false_alarm_rate"):
            numbers[f"edge_{name}{beliefs}"] = getattr(counts, name, None)
        for name in ("precision", "recall", "f1", "accuracy"):
            numbers[f"edge_{name}_now{beliefs}"] = getattr(now, name, None)
        numbers[f"switch_time_error{beliefs}_s"] = late
    return numbers


def calibration_numbers(detail: OpenLoopDetail) -> dict[str, float | None]:
    """Scores of the beliefs' probabilities, see `Calibration`.

    They are of the beliefs about the step after every state, predicted from it; ``_ahead``: about
    the last step of every window, predicted from its start. Then ``_unmeasured`` and ``_inferred``
    as in `error_numbers`. Only edges within the model's cutoff count: beyond it, beliefs are 0 by
    construction, which would flatter the numbers.
    """
    return {
        f"{name}{ending}": getattr(found, score, None)
        for ending, found in _calibrations(detail).items()
        for name, score in (
            ("calibration_error", "expected_error"),
            ("brier_score", "brier_score"),
            ("log_score", "log_score"),
        )
    }


def _calibrations(detail: OpenLoopDetail) -> dict[str, Calibration | None]:
    """By the ending of their JSON keys; None: without such beliefs."""
    return {
        f"{ahead}{beliefs}": getattr(found, step, None)
        for ahead, step in (("", "next_step"), ("_ahead", "last_step"))
        for beliefs in ("", "_unmeasured", "_inferred")
        for found in [getattr(detail, beliefs.removeprefix("_") or "measured")]
    }


def unbeaten_baselines(errors: Mapping[str, float | None]) -> tuple[str, ...]:
    """The baselines whose error over moving bodies the model's is not below.

    ``errors``: m by prediction; the model's own is ``n_step``. An error that is not known is beaten
    by none and beats none; `ORACLE` is left out.
    """
    own = errors["n_step"]
    return tuple(
        name
        for name, error in errors.items()
        if name not in ("n_step", ORACLE)
        and own is not None
        and error is not None
        and not own < (1.0 - _TIE) * error
    )
