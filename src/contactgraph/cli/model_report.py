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


_BASELINES = (
    ("constant_velocity", "constant velocity's"),
    ("standing_still", "standing still's"),
    ("frozen_contact", "the fixed-contact oracle's"),
)
_HORIZONS = {"": "one step ahead", "_ahead": "at the end of the window"}
_SOURCES = {"": "contacts and motion", "_inferred": "motion alone", "_unmeasured": "nothing"}
"""Corrections of beliefs, by the ending of their JSON keys."""


def report_metrics(
    results: Sequence[ConditionResult], model: ModelSummary
) -> tuple[ReportMetric, ...]:
    """Every number of the report, in the order of its table; the hardest condition comes last."""
    seed = int(model.training.get("seed", 0))
    first, last = results[0], results[-1]
    metrics: list[ReportMetric] = []

    def add(name: str, unit: str, value: float | None, command: str, **options: Any) -> None:
        metrics.append(ReportMetric(name, value, unit, command=command, seed=seed, **options))

    def add_error(name: str, one: ConditionResult, tile: bool = False) -> None:
        error = one.open_loop["n_step_rmse_moving_m"]
        error_cm = None if error is None else 100.0 * error
        add(name, "cm", error_cm, one.open_loop_command, tile=tile)

    add_error("N-step error of bodies that move", first, tile=True)
    for baseline, text in _BASELINES:
        ratio = _ratio(
            first.open_loop["n_step_rmse_moving_m"], first.open_loop[f"{baseline}_rmse_moving_m"]
        )
        name = f"the same, share of {text}"
        add(name, "", ratio, first.open_loop_command)
    for one in results[1:]:
        growth = _ratio(
            one.open_loop["n_step_rmse_moving_m"], first.open_loop["n_step_rmse_moving_m"]
        )
        name = f"that error, {one.condition.name} against {first.condition.name}"
        add(name, "times", growth, one.open_loop_command)
    if last is not first:
        add_error(f"N-step error of bodies that move, {last.condition.name}", last)
    for one in (first, last):
        name, f1 = f"edge F1, {one.condition.name}", one.open_loop["edge_f1"]
        add(name, "", f1, one.open_loop_command, tile=one is last)
    for ahead, text in _HORIZONS.items():
        error, command = last.open_loop[f"calibration_error{ahead}"], last.open_loop_command
        name = f"calibration error, {text}, {last.condition.name}"
        add(name, "", error, command)
    for one in results:
        low, high = one.closed_loop["success_interval"]
        add(
            f"success, {one.condition.name}",
            "%",
            100.0 * one.closed_loop["success_rate"],
            one.closed_loop_command,
            tile=True,
            interval=(100.0 * low, 100.0 * high),
        )
    loop, command = first.closed_loop, first.closed_loop_command
    speed, slowest = loop["contact_speed_m_s"], loop["slowest_before_contact_min_m_s"]
    add("speed at contact, median", "m/s", speed, command, tile=True)
    add("slowest on the way there, any episode", "m/s", slowest, command)
    training_s = float(model.training.get("training_s", "nan"))
    trained_by = str(model.training.get("command", ""))
    add("training", "s", training_s, trained_by)
    name = f"control step, horizon {last.closed_loop['horizon']}, {last.condition.name}, 99 %"
    milliseconds, command = last.closed_loop["plan_ms_p99"], last.closed_loop_command
    add(name, "ms", milliseconds, command, tile=True)
    add("model file", "MB", model.size / 1e6, trained_by)
    return tuple(metrics)


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def n_step_errors(results: Sequence[ConditionResult]) -> list[NStepError]:
    """The errors of every condition, by kind of window."""
    errors = []
    for windows, suffix in (
        ("bodies that move, all windows", "_moving"),
        ("all bodies, windows in which a contact changes", "_contact"),
        ("all bodies, windows without a change of contact", "_free"),
        ("all bodies, all windows", ""),
    ):
        for one in results:
            loop = one.open_loop
            errors.append(
                NStepError(
                    condition=one.condition.name,
                    windows=windows,
                    model_m=loop.get(f"n_step_rmse{suffix}_m"),
                    frozen_contact_m=loop.get(f"frozen_contact_rmse{suffix}_m"),
                    constant_velocity_m=loop.get(f"constant_velocity_rmse{suffix}_m"),
                    standing_still_m=loop.get(f"standing_still_rmse{suffix}_m"),
                )
            )
    return errors


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
