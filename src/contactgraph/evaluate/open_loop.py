"""Open-loop evaluation: predictions of recorded trajectories from every one of their states."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    strip_contacts,
    with_edge_labels,
)
from contactgraph.data.dataset import near_origin
from contactgraph.evaluate.baselines import (
    Predictor,
    constant_rates,
    fixed_contact_oracle,
    standing_still,
)
from contactgraph.evaluate.metrics import (
    BASELINES,
    INFERRED,
    MODEL,
    ORACLE,
    UNMEASURED,
    all_numbers,
    json_key,
    unbeaten_baselines,
    verdict,
)
from contactgraph.evaluate.prediction_windows import (
    Prediction,
    RecordedWindows,
    TrajectoryWindows,
)
from contactgraph.evaluate.statistics import Sums, finite_or_none
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

Metric = Callable[[RecordedWindows, Prediction], float | None]
"""A metric of one's own: a number of one prediction of all windows, None where it is not known."""

_USUAL_HORIZON_S = 0.5
_TOLERANCE = 1e-6
"""Relative difference of a horizon from a whole number of steps that counts as none."""

_WITHOUT_FITTING: dict[str, Predictor] = {
    "constant_velocity": constant_rates,
    "standing_still": standing_still,
    ORACLE: fixed_contact_oracle,
}


@dataclass(frozen=True)
class OpenLoopMetrics:
    """The results of `evaluate_open_loop`."""

    recorded: RecordedWindows = field(repr=False, compare=False)
    """Every window on its own."""
    predictions: Mapping[str, Prediction | None] = field(repr=False, compare=False)
    """By name: ``n_step``, the model's, by beliefs that measured contacts and, if requested, the
    observed motion have corrected; ``n_step_unmeasured``, by those that nothing has corrected;
    ``n_step_inferred``, by those that motion alone has corrected; the baselines, and the caller's
    own. None: not known."""
    numbers: Mapping[str, Any]
    """Every metric of every prediction by its JSON key. None: the data do not determine it."""
    unbeaten: tuple[str, ...]
    """Predictions that the model is not better than: see `unbeaten_baselines`."""

    def __getitem__(self, name: str) -> Any:
        """The number with this JSON key."""
        return self.numbers[name]

    def to_json(self) -> dict[str, Any]:
        """All results by name; None for those that are not known or not finite."""
        return {
            name: finite_or_none(value) if isinstance(value, float) else value
            for name, value in self.numbers.items()
        }


def evaluate_open_loop(
    model: StepModel,
    dataset: Dataset,
    *,
    horizon_s: float | None = None,
    sensor: ContactSensor | None = None,
    faults: SensorFault = _EXACT,
    motion_noise: MotionNoise | None = None,
    predictions: Mapping[str, Predictor] | None = None,
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
    ``predictions``: further ones by name, each a function of a trajectory and the number of steps;
    they count for the verdict. ``least_squares`` and ``gnn`` are null unless they are given so.
    ``metrics``: further ones by name, each a function of the `RecordedWindows` and a `Prediction`;
    they are computed for every prediction that is known. ``last_window_of``: the episode that
    each trajectory belongs to, by index, and only the last window of each trajectory is predicted:
    see `forced_windows`.

    Contacts are `with_edge_labels` here: pairs that hold each other, where that is recorded.
    The trajectories may differ in steps and nodes. Where one lacks contacts, none are used.
    Raises `InvalidInputError` where the horizon is no multiple of the step or longer than every
    trajectory, where model and data do not fit, where there are no contacts for faults to corrupt,
    or where a prediction or a metric has the name of a built-in one.
    """
    built_in = {MODEL, UNMEASURED, INFERRED, *_WITHOUT_FITTING}
    if taken := sorted((predictions or {}).keys() & built_in):
        raise InvalidInputError(f"predictions must have new names, found {taken[0]!r}")
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
    lists, parts = ReallocatingModel(model, dataset), []
    given = {**_WITHOUT_FITTING, **(predictions or {})}
    for index, each in enumerate(dataset):
        if each.steps < steps:
            continue
        windows = TrajectoryWindows(dataset, index, steps, bool(last_window_of))
        by_model = partial(windows.predicted_by, lists, sensor=sensor)
        unmeasured = by_model(contacts=None, noise=None)
        inferred = measured = None
        if motion_noise is not None:
            inferred = by_model(contacts=None, noise=motion_noise)
        if each.contact is not None:
            reported = faults.reported(each.contact, each.scene, index)
            measured = by_model(contacts=reported, noise=motion_noise)
        found = {
            MODEL: measured or inferred or unmeasured,
            **dict.fromkeys(BASELINES),
            **{name: windows.predicted(name, of) for name, of in given.items()},
            UNMEASURED: unmeasured,
            INFERRED: inferred,
        }
        parts.append((windows.recorded, found))
    recorded, predicted = map(_concatenated, zip(*parts, strict=True))
    if last_window_of:
        types = dict(zip(last_window_of, recorded.node_types, strict=True))
        recorded = replace(
            recorded, node_types=tuple(types.values()), trajectory=np.array(last_window_of)
        )
    numbers = all_numbers(recorded, predicted)
    numbers |= {"windows": len(recorded.start), "n_steps": steps, "runs": len(recorded.node_types)}
    errors = {name: numbers[json_key(name, "n_step_rmse_moving_m")] for name in predicted}
    unbeaten = unbeaten_baselines(errors)
    numbers["verdict"] = verdict(errors[MODEL], unbeaten)
    own = {
        json_key(which, name): value
        for name, metric in (metrics or {}).items()
        for which, prediction in predicted.items()
        if prediction is not None
        if (value := metric(recorded, prediction)) is not None or which == MODEL
    }
    if taken := sorted(own.keys() & numbers.keys()):
        raise InvalidInputError(f"metrics must have new names, found {taken[0]!r}")
    return OpenLoopMetrics(recorded, predicted, numbers | own, unbeaten)


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
    if not isinstance(first, RecordedWindows | Prediction):
        return first
    names = [each.name for each in fields(first)]
    values = {name: _concatenated([getattr(each, name) for each in parts]) for name in names}
    return type(first)(**values)
