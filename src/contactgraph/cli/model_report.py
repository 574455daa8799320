"""The report of one model: measured numbers, and the page that shows them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.cli.models import in_steps_of, motion_evidence, stored_model
from contactgraph.data import read_trajectories
from contactgraph.envs.registry import TestCondition
from contactgraph.model.io import ModelSummary
from contactgraph.viz import (
    BeliefTimeline,
    LossCurve,
    NStepError,
    ReliabilityCurve,
    ReportMetric,
    belief_timeline,
)


@dataclass(frozen=True)
class ConditionResult:
    """Results of one model under one test condition, as the JSON of two commands."""

    condition: TestCondition
    open_loop: dict[str, Any]
    """Of ``contactgraph evaluate``."""
    closed_loop: dict[str, Any]
    """Of ``contactgraph control``."""
    open_loop_command: str
    closed_loop_command: str


_BASELINES = {
    "constant_velocity": "constant velocity's",
    "standing_still": "standing still's",
    "frozen_contact": "the fixed-contact oracle's",
}
_WINDOWS = {
    "_moving": "bodies that move, all windows",
    "_contact": "all bodies, windows in which a contact changes",
    "_free": "all bodies, windows without a change of contact",
    "": "all bodies, all windows",
}
"""By the ending of the JSON keys of errors."""
_HORIZONS = {"": "one step ahead", "_ahead": "at the end of the window"}
_SOURCES = {"": "contacts and motion", "_inferred": "motion alone", "_unmeasured": "nothing"}
"""Corrections of beliefs, by the ending of their JSON keys."""


def report_metrics(
    results: Sequence[ConditionResult], model: ModelSummary
) -> tuple[ReportMetric, ...]:
    """Every number of the report, in the order of its table; the hardest condition comes last."""
    seed = int(model.training.get("seed", 0))
    first, last = results[0], results[-1]
    error = {one.condition.name: one.open_loop["n_step_rmse_moving_m"] for one in results}
    usual, hardest = first.condition.name, last.condition.name
    metrics: list[ReportMetric] = []

    def add(name: str, unit: str, value: float | None, command: str, **options: Any) -> None:
        metrics.append(ReportMetric(name, value, unit, command=command, seed=seed, **options))

    command = first.open_loop_command
    name = "N-step error of bodies that move"
    add(name, "cm", _times(100.0, error[usual]), command, tile=True)
    for baseline, text in _BASELINES.items():
        ratio = _ratio(error[usual], first.open_loop[f"{baseline}_rmse_moving_m"])
        add(f"the same, share of {text}", "", ratio, command)
    for one in results[1:]:
        growth = _ratio(error[one.condition.name], error[usual])
        text = f"that error, {one.condition.name} against {usual}"
        add(text, "times", growth, one.open_loop_command)
    if last is not first:
        add(f"{name}, {hardest}", "cm", _times(100.0, error[hardest]), last.open_loop_command)
    for one in (first, last):
        name, f1 = f"edge F1, {one.condition.name}", one.open_loop["edge_f1"]
        add(name, "", f1, one.open_loop_command, tile=one is last)
    for ahead, text in _HORIZONS.items():
        name, value = f"calibration error, {text}, {hardest}", f"calibration_error{ahead}"
        add(name, "", last.open_loop[value], last.open_loop_command)
    for one in results:
        name, loop = f"success, {one.condition.name}", one.closed_loop
        low, high = (100.0 * end for end in loop["success_interval"])
        share, command = 100.0 * loop["success_rate"], one.closed_loop_command
        add(name, "%", share, command, tile=True, interval=(low, high))
    loop, command = first.closed_loop, first.closed_loop_command
    speed, slowest = loop["contact_speed_m_s"], loop["slowest_before_contact_min_m_s"]
    add("speed at contact, median", "m/s", speed, command, tile=True)
    add("slowest on the way there, any episode", "m/s", slowest, command)
    trained_by = str(model.training.get("command", ""))
    add("training", "s", float(model.training.get("training_s", "nan")), trained_by)
    loop, command = last.closed_loop, last.closed_loop_command
    name = f"control step, horizon {loop['horizon']}, {hardest}, 99 %"
    add(name, "ms", loop["plan_ms_p99"], command, tile=True)
    add("model file", "MB", model.size / 1e6, trained_by)
    return tuple(metrics)


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def n_step_errors(results: Sequence[ConditionResult]) -> list[NStepError]:
    """The errors of every condition, by kind of window."""
    names = {"model": "n_step", **{baseline: baseline for baseline in _BASELINES}}
    return [
        NStepError(
            condition=one.condition.name,
            windows=windows,
            **{
                f"{field}_m": one.open_loop.get(f"{name}_rmse{ending}_m")
                for field, name in names.items()
            },
        )
        for ending, windows in _WINDOWS.items()
        for one in results
    ]


def reliability_curves(result: ConditionResult) -> list[ReliabilityCurve]:
    """The reliability of beliefs under one condition, by horizon and by what corrected them."""
    loop, condition = result.open_loop, result.condition.name
    return [
        ReliabilityCurve(
            panel=f"{text}, {condition}",
            source=source,
            bins=tuple((count, belief, share) for count, belief, share in bins if count),
            error=loop[f"calibration_error{ahead}{beliefs}"],
        )
        for ahead, text in _HORIZONS.items()
        for beliefs, source in _SOURCES.items()
        if (bins := loop.get(f"reliability{ahead}{beliefs}"))
    ]


def inferred_beliefs(
    model_name: str, name: str, data: Path, open_loop: Mapping[str, Any]
) -> BeliefTimeline | None:
    """Beliefs over time about one edge of a recorded file, with the scores of all edges in it.

    ``model_name`` is a ``MODEL`` argument, ``name`` that of the trajectories, and ``open_loop`` the
    JSON of ``contactgraph evaluate`` for the file. None where no edge changes.
    """
    model = stored_model(model_name)
    dataset = in_steps_of(model, read_trajectories(data), str(data))
    timeline = belief_timeline(model, dataset, name, motion_evidence(model, False, False))
    if timeline is None:
        return None
    endings = {source: ending for ending, source in _SOURCES.items()} | {"contacts": ""}
    scores = {
        source: (
            open_loop[f"edge_f1_now{endings[source]}"],
            open_loop[f"n_step_rmse_moving{endings[source]}_m"],
        )
        for source in timeline.belief
    }
    return replace(timeline, scores=scores)


def loss_curves(history: Sequence[Mapping[str, float]]) -> list[LossCurve]:
    """The curves of a training; ``history`` are the rows of its ``metrics.jsonl``."""
    if not history:
        return []
    step = np.array([row["step"] for row in history])
    names = [name for name in history[0] if name not in ("step", "seconds", "held_out_rmse_m")]
    curves = [LossCurve(name, step, np.array([row[name] for row in history])) for name in names]
    held_out = np.array([row["held_out_rmse_m"] for row in history])
    return [*curves, LossCurve("position error, m", step, held_out, held_out=True)]
