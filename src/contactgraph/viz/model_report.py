"""The numbers of one model's report: what was measured under each test condition, and is asked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from contactgraph.viz import LossCurve, NStepError, Number, ReportData, SceneRun
from contactgraph_studies.declared import HORIZON_S, StudyTask, TestCondition
from contactgraph_studies.targets import TARGETS, Asked, asked_error_cm


@dataclass(frozen=True)
class ConditionResult:
    """What one model did under one test condition; JSON of the two commands, by their keys."""

    condition: TestCondition
    open_loop: dict[str, Any]
    """Of ``contactgraph evaluate``."""
    closed_loop: dict[str, Any]
    """Of ``contactgraph control``."""
    open_loop_command: str
    closed_loop_command: str
    seed: int
    """Of the test scenes."""


@dataclass(frozen=True)
class ModelResult:
    """One training and all its test conditions."""

    task: StudyTask
    seed: int
    """Of the training."""
    conditions: tuple[ConditionResult, ...]
    """The one in distribution first."""
    training_s: float
    """Wall time of training, compilation included, s."""
    model_bytes: int
    training_command: str


def report_numbers(result: ModelResult) -> tuple[Number, ...]:
    """Every number of the report, in the order of its table."""
    task, first, last = result.task, result.conditions[0], result.conditions[-1]
    targets = TARGETS[task.name]
    against_floor = _ratio(
        first.open_loop["n_step_rmse_m"], first.open_loop["frozen_contact_rmse_m"]
    )
    numbers = [
        _predicted(
            "N-step error",
            first,
            "n_step_rmse_m",
            asked_error_cm(task, first.condition),
            tile=True,
        ),
        _number(
            "the same, share of the frozen-contact floor",
            "",
            against_floor,
            first.open_loop_command,
            Asked(0.25),
            lower=True,
        ),
    ]
    for one in result.conditions[1:]:
        grown = _ratio(
            one.open_loop["n_step_rmse_moving_m"], first.open_loop["n_step_rmse_moving_m"]
        )
        name = f"error of moving bodies, {one.condition.name} against {first.condition.name}"
        # Bystanders should change nothing; further objects to handle are another matter.
        asked = Asked(1.2, 1.0) if one.condition.distractors else None
        numbers.append(_number(name, "times", grown, one.open_loop_command, asked, lower=True))
    name = f"N-step error, {last.condition.name}, all nodes"
    numbers.append(_predicted(name, last, "n_step_rmse_m", asked_error_cm(task, last.condition)))
    for one in (first, last):
        f1, asked = one.open_loop["edge_f1"], targets.edge_f1[one.condition.in_distribution]
        name = f"edge F1, {one.condition.name}"
        tile = one is last
        numbers.append(_number(name, "", f1, one.open_loop_command, asked, tile=tile))
    numbers += [
        _success(one, targets.success_percent[one.condition.in_distribution])
        for one in result.conditions
    ]
    loop, command = first.closed_loop, first.closed_loop_command
    speed, slowest = loop["contact_speed_m_s"], loop["slowest_before_contact_min_m_s"]
    numbers += [
        _number(
            "speed at contact, median",
            "m/s",
            speed,
            command,
            targets.contact_speed,
            tile=True,
        ),
        _number("slowest on the way there, any episode", "m/s", slowest, command, None),
        _number(
            "training",
            "s",
            result.training_s,
            result.training_command,
            targets.training_s,
            lower=True,
        ),
        _number(
            f"control tick, horizon {last.closed_loop['horizon']}, {last.condition.name}, 99 %",
            "ms",
            last.closed_loop["plan_ms_p99"],
            last.closed_loop_command,
            targets.tick_ms,
            lower=True,
            tile=True,
        ),
        _number(
            "model file",
            "MB",
            result.model_bytes / 1e6,
            result.training_command,
            Asked(1.0),
            lower=True,
        ),
    ]
    return tuple(one(result.seed) for one in numbers)


_Unseeded = Callable[[int], Number]
"""A number that lacks the seed of the training alone."""


def _number(
    name: str,
    unit: str,
    value: float | None,
    command: str,
    asked: Asked | None,
    lower: bool = False,
    tile: bool = False,
    interval: tuple[float, float] | None = None,
) -> _Unseeded:
    def seeded(seed: int) -> Number:
        return Number(
            name=name,
            value=value,
            unit=unit,
            interval=interval,
            at_least=None if asked is None else asked.at_least,
            aim=None if asked is None else asked.aim,
            lower_is_better=lower,
            command=command,
            seed=seed,
            tile=tile,
        )

    return seeded


def _predicted(
    name: str, one: ConditionResult, key: str, asked: Asked | None, tile: bool = False
) -> _Unseeded:
    value = one.open_loop[key]
    centimetres = None if value is None else 100.0 * value
    return _number(name, "cm", centimetres, one.open_loop_command, asked, lower=True, tile=tile)


def _success(one: ConditionResult, asked: Asked) -> _Unseeded:
    low, high = one.closed_loop["success_interval"]
    return _number(
        f"success, {one.condition.name}",
        "%",
        100.0 * one.closed_loop["success_rate"],
        one.closed_loop_command,
        asked,
        tile=True,
        interval=(100.0 * low, 100.0 * high),
    )


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


_TITLES = {
    "pickup": "A contact graph that picks things up",
    "multi-pickup": "A contact graph that picks up one thing after another",
    "door": "A contact graph that opens doors",
    "franka": "A contact graph that picks things up with an arm",
}


def model_report(
    result: ModelResult,
    numbers: Sequence[Number],
    scenes: Sequence[SceneRun],
    metrics: Sequence[Mapping[str, float]],
    versions: Mapping[str, str],
    remake: Sequence[str],
) -> ReportData:
    """The page's data; `metrics` are the rows of the training's ``metrics.jsonl``."""
    return ReportData(
        title=_TITLES[result.task.name],
        summary=(
            "From recorded runs of a gripper at work, a model learned which bodies touch when and "
            "how they move then; iLQR-MPC uses it to do the same in scenes that it has never seen."
        ),
        numbers=tuple(numbers),
        runs=tuple(scenes),
        errors=tuple(_errors(result.conditions)),
        horizon_s=HORIZON_S,
        losses=tuple(_losses(metrics)),
        versions=dict(versions),
        remake=tuple(remake),
    )


def _errors(conditions: Sequence[ConditionResult]) -> list[NStepError]:
    errors = []
    for windows, key in (
        ("windows in which a contact changes", "contact"),
        ("windows without a change of contact", "free"),
        ("all windows", "all"),
    ):
        for one in conditions:
            loop = one.open_loop
            own = "n_step_rmse_m" if key == "all" else f"n_step_rmse_{key}_m"
            suffix = "" if key == "all" else f"_{key}"
            errors.append(
                NStepError(
                    condition=one.condition.name,
                    windows=windows,
                    model_m=loop.get(own),
                    frozen_contact_m=loop.get(f"frozen_contact_rmse{suffix}_m"),
                    constant_velocity_m=loop.get(f"constant_velocity_rmse{suffix}_m"),
                )
            )
    return errors


def _losses(metrics: Sequence[Mapping[str, float]]) -> list[LossCurve]:
    if not metrics:
        return []
    step = np.array([row["step"] for row in metrics])
    names = [name for name in metrics[0] if name not in ("step", "seconds", "held_out_rmse_m")]
    curves = [LossCurve(name, step, np.array([row[name] for row in metrics])) for name in names]
    held_out = np.array([row["held_out_rmse_m"] for row in metrics])
    return [*curves, LossCurve("position error, m", step, held_out, held_out=True)]
