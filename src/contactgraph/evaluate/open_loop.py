"""Open-loop evaluation: predictions of recorded trajectories from every one of their states."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Trajectory,
    strip_contacts,
    with_edge_labels,
)
from contactgraph.data.dataset import near_origin
from contactgraph.evaluate.baselines import (
    Baseline,
    constant_velocity,
    fixed_contact_oracle,
    standing_still,
)
from contactgraph.evaluate.mass_scores import mass_numbers
from contactgraph.evaluate.open_loop_detail import OpenLoopDetail, WindowPredictions
from contactgraph.evaluate.open_loop_metrics import (
    ORACLE,
    OpenLoopMetrics,
    angle_numbers,
    calibration_numbers,
    edge_numbers,
    error_numbers,
    errors_by_run,
    numbers_by_type,
    pin_drift,
    rest_drift,
    turned_over_accuracy,
    unbeaten_baselines,
)
from contactgraph.evaluate.prediction_windows import trajectory_detail
from contactgraph.evaluate.statistics import Sums
from contactgraph.large_scenes import ReallocatingModel
from contactgraph.model import (
    ContactSensor,
    MotionNoise,
    StepModel,
    check_motion_model,
    default_sensor,
)
from contactgraph.model.scene import check_fit
from contactgraph.policies.sensor_faults import SensorFault, SensorFaults

_EXACT = SensorFaults()

Metric = Callable[[OpenLoopDetail], float | None]
"""A metric of one's own: a number computed from all windows, None where it is not known."""

_USUAL_HORIZON_S = 0.5
_TOLERANCE = 1e-6
"""Relative difference of a horizon from a whole number of steps that counts as none."""


def _not_fitted(trajectory: Trajectory, steps: int) -> None:
    return None


_BASELINES: dict[str, Baseline] = {
    "constant_velocity": constant_velocity,
    "standing_still": standing_still,
    ORACLE: fixed_contact_oracle,
    "least_squares": _not_fitted,
    "gnn": _not_fitted,
}


def evaluate_open_loop(
    model: StepModel,
    dataset: Dataset,
    *,
    horizon_s: float | None = None,
    sensor: ContactSensor | None = None,
    faults: SensorFault = _EXACT,
    motion_noise: MotionNoise | None = None,
    baselines: Mapping[str, Baseline] | None = None,
    metrics: Mapping[str, Metric] | None = None,
    last_window_of: Sequence[int] = (),
) -> OpenLoopMetrics:
    """Predicts ``horizon_s`` [s] ahead from every state of every trajectory that is long enough.

    The horizon is a multiple of the time step; by default 0.5 s, in whole steps, at least one.

    Up to a window's start the belief is filtered along the recorded history: predicted for every
    step, then corrected by the contacts measured after it (with ``sensor``'s error rates, where
    contacts are recorded). From there on only the recorded controls are known. An edge counts as
    predicted in a step where its probability is above 1/2.

    ``faults`` corrupts the contacts that correct the belief; scores are against the recorded truth.
    ``sensor`` has the same error rates and delay by default, and without faults is the model's
    `default_sensor`. With ``motion_noise`` (see `contactgraph.inference.motion_noise`) the observed
    motion corrects the belief, too, and beliefs corrected by motion alone are evaluated besides.
    ``baselines``: predictions beside those without fitting, by name (``least_squares`` and ``gnn``
    are null otherwise). ``metrics``: further metrics by name, each a function of the
    `OpenLoopDetail`. ``last_window_of``: the episode that each trajectory belongs to, by index, and
    only the last window of each trajectory is predicted: see `forced_windows`.

    Contacts are `with_edge_labels` here: pairs that hold each other, where that is recorded.
    The trajectories may differ in steps and nodes. Where one lacks contacts, none are used.
    Raises `InvalidInputError` where the horizon is no multiple of the step or longer than every
    trajectory, where model and data do not fit, where there are no contacts for faults to corrupt,
    or where a metric has the name of a built-in one.
    """
    for each in dataset:
        check_fit(model, each.scene, each.control_size, "the data")
    if motion_noise is not None:
        check_motion_model(model)
    steps = horizon_steps(dataset, horizon_s)
    labelled = with_edge_labels(dataset)
    if sensor is None:
        sensor = default_sensor(model) if faults.exact else faults.sensor
    sensor = replace(sensor, reports_touch=labelled is dataset)
    dataset = near_origin(labelled)
    lacking = sum(each.contact is None for each in dataset)
    if lacking and not faults.exact:
        raise InvalidInputError(
            f"faults spoil measured contacts, but {lacking} of {len(dataset)} trajectories have no "
            f"contact field; it must be in every trajectory"
        )
    if lacking:
        dataset = strip_contacts(dataset)
    lists = ReallocatingModel(model, dataset)
    detail = _concatenated(
        [
            trajectory_detail(
                lists,
                dataset,
                index,
                steps,
                sensor,
                faults,
                {**_BASELINES, **(baselines or {})},
                motion_noise,
                last=bool(last_window_of),
            )
            for index, each in enumerate(dataset)
            if each.steps >= steps
        ]
    )
    types = [each.scene.node_type for each in dataset]
    if last_window_of:
        types = list(dict(zip(last_window_of, types, strict=True)).values())
        detail = replace(detail, trajectory=np.array(last_window_of))
    errors = error_numbers(detail)
    diverged = ~np.isfinite(detail.measured.squared_error).all(axis=(1, 2))
    found = OpenLoopMetrics(
        runs=len(types),
        windows=len(detail.start),
        n_steps=steps,
        diverged_windows=int(diverged.sum()),
        numbers={
            **errors,
            **angle_numbers(detail),
            "rest_drift_m": rest_drift(detail),
            "pin_drift_m": pin_drift(detail),
            "turned_over_accuracy": turned_over_accuracy(detail),
            **edge_numbers(detail),
            **calibration_numbers(detail),
            **mass_numbers(detail.measured.mass_errors),
        },
        unbeaten=unbeaten_baselines(
            {name: errors[f"{name}_rmse_moving_m"] for name in ("n_step", *detail.baselines)}
        ),
        detail=detail,
        by_type=numbers_by_type(detail, types),
        by_run=errors_by_run(detail, len(types)),
    )
    taken = sorted(found.to_json().keys() & (metrics or {}))
    if taken:
        raise InvalidInputError(f"metrics must have new names, found {taken[0]!r}")
    return replace(found, extra={name: of(detail) for name, of in (metrics or {}).items()})


def horizon_steps(dataset: Dataset, horizon_s: float | None) -> int:
    """Steps of a horizon, s; None: 0.5 s. Raises as `evaluate_open_loop` does."""
    dt, longest = dataset.dt, max(each.steps for each in dataset)
    asked = _USUAL_HORIZON_S if horizon_s is None else horizon_s
    steps = round(asked / dt) if math.isfinite(asked) else 0
    if horizon_s is None:
        steps = max(1, steps)
    elif abs(steps * dt - horizon_s) > _TOLERANCE * dt:
        steps = 0
    if not 1 <= steps <= longest:
        raise InvalidInputError(
            f"the horizon must be a multiple of the time step, {dt:g} s, up to {longest * dt:g} s, "
            f"the longest trajectory, found {asked:g} s"
        )
    return steps


def _concatenated(parts: Sequence[Any]) -> Any:
    """Arrays one after the other, counts added, field by field; None where any part has None."""
    first = parts[0]
    if any(each is None for each in parts):
        return None
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, Sums):
        return sum(parts[1:], first)
    if isinstance(first, dict):
        return {name: _concatenated([each[name] for each in parts]) for name in first}
    if not isinstance(first, OpenLoopDetail | WindowPredictions):
        return first
    names = [each.name for each in fields(first)]
    values = {name: _concatenated([getattr(each, name) for each in parts]) for name in names}
    return type(first)(**values)
