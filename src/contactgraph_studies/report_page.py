"""The report page of one model, filled from what was measured."""

from collections.abc import Mapping, Sequence

import numpy as np

from contactgraph.viz import LossCurve, NStepError, Number, ReportData, SceneRun
from contactgraph_studies.declared import HORIZON_S
from contactgraph_studies.report_numbers import ConditionResult, ModelResult

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
