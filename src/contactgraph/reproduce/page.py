"""The report page of a pickup model, filled from what was measured."""

from collections.abc import Mapping, Sequence

import numpy as np

from contactgraph.reproduce.figures import ConditionResult, Figure, SeedResult
from contactgraph.view import LossCurve, NStepError, Number, ReportData, SceneRun

_TILES = ("N-step error", "success, ", "edge F1, 10", "speed at contact", "control tick")


def pickup_report(
    results: Sequence[SeedResult],
    figures: Sequence[Figure],
    scenes: Sequence[SceneRun],
    metrics: Sequence[Mapping[str, float]],
    versions: Mapping[str, str],
    remake: Sequence[str],
) -> ReportData:
    """The page's data; `metrics` are the rows of the first training's ``metrics.jsonl``."""
    first = results[0].conditions
    return ReportData(
        title="A contact graph that picks things up",
        summary=(
            "From recorded runs of a gripper sweeping up an object, a model learned when the two "
            "touch and how they move then; iLQR-MPC uses it to do the same among objects that "
            "it has never seen."
        ),
        numbers=tuple(_number(figure, results) for figure in figures),
        runs=tuple(scenes),
        errors=tuple(_errors(first)),
        horizon_s=0.5,
        losses=tuple(_losses(metrics)),
        versions=dict(versions),
        remake=tuple(remake),
    )


def _number(figure: Figure, results: Sequence[SeedResult]) -> Number:
    interval = _success_interval(figure, results)
    if interval is None and len(figure.values) > 1:
        interval = (min(figure.values), max(figure.values))
    return Number(
        name=figure.name,
        value=figure.median,
        unit=figure.unit,
        interval=interval,
        at_least=figure.at_least,
        aim=figure.aim,
        lower_is_better=figure.lower_is_better,
        command=figure.command,
        seed=tuple(result.seed for result in results),
        tile=any(figure.name == tile or figure.name.startswith(tile) for tile in _TILES)
        and "all nodes" not in figure.name,
    )


def _success_interval(figure: Figure, results: Sequence[SeedResult]) -> tuple[float, float] | None:
    """The 95 % interval of a success rate, of the first training's episodes."""
    for condition in results[0].conditions.values():
        if figure.name.startswith("success") and figure.command == condition.closed_loop_command:
            low, high = condition.closed_loop["success_interval"]
            return 100.0 * low, 100.0 * high
    return None


def _errors(conditions: Mapping[int, ConditionResult]) -> list[NStepError]:
    errors = []
    for windows, key in (
        ("windows in which a contact changes", "contact"),
        ("windows without a change of contact", "free"),
        ("all windows", "all"),
    ):
        for count, condition in conditions.items():
            loop = condition.open_loop
            own = "n_step_rmse_m" if key == "all" else f"n_step_rmse_{key}_m"
            suffix = "" if key == "all" else f"_{key}"
            errors.append(
                NStepError(
                    condition=f"{count} distractors" if count else "no distractors",
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
