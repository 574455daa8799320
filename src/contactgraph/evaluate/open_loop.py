"""Open-loop evaluation: predictions of recorded trajectories from every one of their states."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields

import numpy as np

from contactgraph.data import Dataset, InvalidInputError, Trajectory, with_edge_labels
from contactgraph.evaluate.edge_scores import edge_scores
from contactgraph.evaluate.prediction_windows import (
    OpenLoopDetail,
    WindowPredictions,
    concatenated_details,
    trajectory_detail,
)
from contactgraph.evaluate.sensor_faults import SensorFaults
from contactgraph.model import (
    ContactSensor,
    MotionNoise,
    ReallocatingModel,
    StepModel,
    check_motion_model,
)
from contactgraph.model.filter import check_fit

_EXACT = SensorFaults()

Metric = Callable[[OpenLoopDetail], float | None]
"""A metric of one's own: a number computed from all windows, None where it is not known."""


@dataclass(frozen=True)
class OpenLoopMetrics:
    """The results of `evaluate_open_loop`. None: the data do not determine a number.

    Errors are over the same windows: from every start of every trajectory, ``n_steps`` ahead. The
    names are the keys of `to_json`. ``…_unmeasured`` is the same prediction by beliefs that no
    measured contact has corrected, equal to the first where contacts were not recorded.
    ``…_inferred`` is the same by beliefs that only the observed motion has corrected; None unless
    requested.
    """

    runs: int
    """Number of trajectories."""
    windows: int
    n_steps: int
    """Steps in a window."""
    diverged_windows: int
    """Windows with a prediction that is not finite; one of them makes the errors infinite."""

    n_step_rmse_m: float
    """Root mean square position error over windows, steps and nodes, m."""
    n_step_rmse_moving_m: float | None
    """Only nodes that get more than 1 mm away from their position at the window's start."""
    n_step_rmse_free_m: float | None
    """Only windows in which no contact changes."""
    n_step_rmse_contact_m: float | None
    """Only windows in which a contact changes."""
    n_step_rmse_unmeasured_m: float
    constant_velocity_rmse_m: float
    """Baseline without forces: see `constant_velocity`."""
    frozen_contact_rmse_m: float | None
    """Fixed-contact oracle: see `fixed_contact_oracle`."""
    constant_velocity_rmse_free_m: float | None
    constant_velocity_rmse_contact_m: float | None
    frozen_contact_rmse_free_m: float | None
    frozen_contact_rmse_contact_m: float | None
    """The baselines over the windows without and with a change of contact, as above."""

    edge_precision: float | None
    edge_recall: float | None
    edge_f1: float | None
    edge_accuracy: float | None
    edge_false_alarm_rate: float | None
    """Share of edges without contact that are predicted active."""
    switch_time_error_s: float | None
    """Mean time between the predicted and the true onset of contact: see `switch_time_errors`."""
    edge_on_time: float | None
    """Share of touches whose edge is predicted active, one step before, for their very step."""
    edge_precision_unmeasured: float | None
    edge_recall_unmeasured: float | None
    edge_f1_unmeasured: float | None
    edge_accuracy_unmeasured: float | None
    switch_time_error_unmeasured_s: float | None
    edge_on_time_unmeasured: float | None
    n_step_rmse_inferred_m: float | None
    edge_precision_inferred: float | None
    edge_recall_inferred: float | None
    edge_f1_inferred: float | None
    edge_accuracy_inferred: float | None
    switch_time_error_inferred_s: float | None
    edge_on_time_inferred: float | None

    extra: dict[str, float | None] = field(repr=False, compare=False)
    """Metrics of the caller's own, by name; in `to_json` beside the others."""
    detail: OpenLoopDetail = field(repr=False, compare=False)
    """Every window on its own; not part of `to_json`."""

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not known or not finite."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        del numbers["detail"], numbers["extra"]
        return {
            name: value if value is None or math.isfinite(value) else None
            for name, value in {**numbers, **self.extra}.items()
        }


def evaluate_open_loop(
    model: StepModel,
    dataset: Dataset,
    *,
    horizon_s: float = 0.5,
    sensor: ContactSensor | None = None,
    faults: SensorFaults = _EXACT,
    motion_noise: MotionNoise | None = None,
    metrics: Mapping[str, Metric] | None = None,
) -> OpenLoopMetrics:
    """Predicts ``horizon_s`` [s] ahead from every state of every trajectory that is long enough.

    Up to a window's start the belief is filtered along the recorded history: predicted for every
    step, then corrected by the contacts measured after it (with ``sensor``'s error rates, where
    contacts are recorded). From there on only the recorded controls are known. An edge counts as
    predicted in a step where its probability is above 1/2.

    ``faults`` corrupts the contacts that correct the belief; scores are against the recorded truth.
    ``sensor`` has the same error rates by default. With ``motion_noise``, contacts inferred from
    motion alone are evaluated, too. ``metrics``: further metrics by name, each a function of the
    `OpenLoopDetail`.

    Contacts are `with_edge_labels` here: pairs that hold each other, where that is recorded.
    The trajectories may differ in steps and nodes. Where one lacks contacts, none are used.
    Raises `InvalidInputError` where the horizon is shorter than half a step or longer than every
    trajectory, where model and data do not fit, where there are no contacts for faults to corrupt,
    or where a metric has the name of a built-in one.
    """
    for each in dataset:
        check_fit(model, each.scene, each.control_size, "the data")
    if motion_noise is not None:
        check_motion_model(model)
    metrics = metrics or {}
    taken = [each.name for each in fields(OpenLoopMetrics) if each.name in metrics]
    if taken:
        raise InvalidInputError(f"metrics must have new names, found {taken[0]!r}")
    steps = _steps(dataset, horizon_s)
    dataset = with_edge_labels(dataset)
    known = all(each.contact is not None for each in dataset)
    if not (known or faults.exact):
        lacking = sum(each.contact is None for each in dataset)
        raise InvalidInputError(
            f"faults spoil measured contacts, but {lacking} of {len(dataset)} trajectories have no "
            f"contact field; it must be in every trajectory"
        )
    lists = ReallocatingModel(model, dataset)
    detail = concatenated_details(
        [
            trajectory_detail(
                lists,
                dataset,
                index,
                steps,
                sensor or faults.sensor,
                _reported(each, faults, index) if known else None,
                motion_noise,
            )
            for index, each in enumerate(dataset)
            if each.steps >= steps
        ]
    )
    measured, inferred = detail.measured, detail.inferred
    still = _by_contact_change(detail, detail.constant_velocity)
    fixed = _by_contact_change(detail, detail.fixed_contact)
    free = _by_contact_change(detail, measured.squared_error)
    return OpenLoopMetrics(
        runs=len(dataset),
        windows=len(detail.start),
        n_steps=steps,
        diverged_windows=int(np.sum(~np.isfinite(measured.squared_error).all(axis=(1, 2)))),
        n_step_rmse_m=_required(detail.rmse(measured.squared_error)),
        n_step_rmse_moving_m=detail.rmse(measured.squared_error, detail.moves),
        n_step_rmse_free_m=free[0],
        n_step_rmse_contact_m=free[1],
        n_step_rmse_unmeasured_m=_required(detail.rmse(detail.unmeasured.squared_error)),
        n_step_rmse_inferred_m=_rmse(detail, None if inferred is None else inferred.squared_error),
        constant_velocity_rmse_m=_required(detail.rmse(detail.constant_velocity)),
        constant_velocity_rmse_free_m=still[0],
        constant_velocity_rmse_contact_m=still[1],
        frozen_contact_rmse_m=_rmse(detail, detail.fixed_contact),
        frozen_contact_rmse_free_m=fixed[0],
        frozen_contact_rmse_contact_m=fixed[1],
        extra={name: metric(detail) for name, metric in metrics.items()},
        detail=detail,
        **_scores(detail, measured, "", ("false_alarm_rate",)),
        **_scores(detail, detail.unmeasured, "_unmeasured"),
        **_scores(detail, inferred, "_inferred"),
    )


def _steps(dataset: Dataset, horizon_s: float) -> int:
    longest = max(each.steps for each in dataset)
    steps = round(horizon_s / dataset.dt) if math.isfinite(horizon_s) else 0
    if not 1 <= steps <= longest:
        raise InvalidInputError(
            f"horizon_s must be {dataset.dt:g} to {longest * dataset.dt:g} s, from one step to "
            f"the longest trajectory, found {horizon_s}"
        )
    return steps


def _reported(trajectory: Trajectory, faults: SensorFaults, index: int) -> np.ndarray | None:
    if trajectory.contact is None:
        return None
    return faults.reported(trajectory.contact, trajectory.scene, index)


def _rmse(detail: OpenLoopDetail, squared: np.ndarray | None) -> float | None:
    return None if squared is None else detail.rmse(squared)


def _by_contact_change(
    detail: OpenLoopDetail, squared: np.ndarray | None
) -> tuple[float | None, float | None]:
    """RMSE over the windows in which no contact changes, and over those in which one does."""
    changes = detail.contact_changes
    if squared is None or changes is None:
        return None, None
    return detail.rmse(squared, ~changes), detail.rmse(squared, changes)


def _scores(
    detail: OpenLoopDetail,
    windows: WindowPredictions | None,
    suffix: str,
    more: tuple[str, ...] = (),
) -> dict[str, float | None]:
    """Edge scores by their names in `OpenLoopMetrics`; None where they are not known."""
    scores = None
    if detail.contact is not None and windows is not None:
        scores = edge_scores(
            windows.edge_active,
            detail.contact,
            detail.edge_exists,
            windows.touch_on_time,
            detail.dt,
        )
    counts = None if scores is None else scores.counts
    names = ("precision", "recall", "f1", "accuracy", *more)
    return {
        **{f"edge_{name}{suffix}": getattr(counts, name, None) for name in names},
        f"edge_on_time{suffix}": None if scores is None else scores.on_time,
        f"switch_time_error{suffix}_s": None if scores is None else scores.switch_time_error_s,
    }


def _required(value: float | None) -> float:
    """There is at least one window, and each has a node that is compared."""
    return math.nan if value is None else value
