"""How well a model predicts recorded runs, from every state of them, without looking again."""

import math
from dataclasses import dataclass, field, fields

import numpy as np

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.evaluate.edge_scores import EdgeScores, edge_scores
from contactgraph.evaluate.prediction_windows import (
    OpenLoopDetail,
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
_NOT_SCORED = EdgeScores(None, None, None, None, None, None, None)


@dataclass(frozen=True)
class OpenLoopMetrics:
    """What `evaluate_open_loop` measures. None: the runs do not hold what it takes to know.

    Errors are over the same windows: from every start of every run, ``n_steps`` ahead. The names
    are the keys of `to_json`. ``…_unmeasured`` is the same prediction by beliefs that no measured
    contact has corrected; where contacts were not recorded the two are equal. ``…_inferred`` is the
    same by beliefs that no measured contact but the motion seen has corrected; None where they were
    not asked for.
    """

    runs: int
    windows: int
    n_steps: int
    """Steps in a window."""
    diverged_windows: int
    """Windows with a prediction that is not finite; one of them makes the errors infinite."""

    n_step_rmse_m: float
    """Root mean square position error over windows, steps and nodes, m."""
    n_step_rmse_moving_m: float | None
    """Only nodes that get more than 1 mm away from where they were at the window's start."""
    n_step_rmse_free_m: float | None
    """Only windows in which no contact changes."""
    n_step_rmse_contact_m: float | None
    """Only windows in which a contact changes."""
    n_step_rmse_unmeasured_m: float
    constant_velocity_rmse_m: float
    """Of no forces: see `constant_velocity`."""
    frozen_contact_rmse_m: float | None
    """Of true masses and the contacts of each window's first state: see `frozen_contact`."""
    constant_velocity_rmse_free_m: float | None
    constant_velocity_rmse_contact_m: float | None
    frozen_contact_rmse_free_m: float | None
    frozen_contact_rmse_contact_m: float | None
    """The floors over the windows without and with a change of contact, as above."""

    edge_precision: float | None
    edge_recall: float | None
    edge_f1: float | None
    edge_accuracy: float | None
    edge_false_alarm_rate: float | None
    """Share of edges that are predicted active of those without contact."""
    switch_time_error_s: float | None
    """Mean time between the predicted and the true onset of contact: see `switch_time_errors`."""
    edge_on_time: float | None
    """Share of touches whose edge is active, as predicted one step before, in their very step."""
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

    detail: OpenLoopDetail = field(repr=False, compare=False)
    """Every window on its own; not part of `to_json`."""

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not known or not finite."""
        numbers = {each.name: getattr(self, each.name) for each in fields(self)}
        del numbers["detail"]
        return {
            name: value if value is None or math.isfinite(value) else None
            for name, value in numbers.items()
        }


def evaluate_open_loop(
    model: StepModel,
    dataset: Dataset,
    *,
    horizon_s: float = 0.5,
    sensor: ContactSensor | None = None,
    faults: SensorFaults = _EXACT,
    motion_noise: MotionNoise | None = None,
) -> OpenLoopMetrics:
    """Predicts ``horizon_s`` [s] ahead from every state of every run that is long enough.

    Up to a window's start the belief is carried along the recorded history: predicted for every
    step, then corrected by the contacts measured after it (with ``sensor``'s error rates, where
    contacts are recorded). From there on only the recorded controls are known. An edge counts as
    predicted in a step where its probability is above 1/2.

    ``faults`` spoils the contacts that the belief is corrected by; what is scored stays the
    recorded truth. ``sensor`` is by default told of the same rates.

    ``motion_noise``: with it, what contacts inferred from motion alone are worth is measured, too.

    The runs may differ in steps and nodes. Contacts, where any run lacks them, are known of none.
    Raises `InvalidInputError` where the horizon is shorter than half a step or longer than every
    run, where model and data do not fit, or where there are no contacts for faults to spoil.
    """
    for run in dataset:
        check_fit(model, run.scene, run.control_size, "the data")
    if motion_noise is not None:
        check_motion_model(model)
    steps = _steps(dataset, horizon_s)
    known = all(run.contact is not None for run in dataset)
    if not (known or faults.exact):
        lacking = sum(run.contact is None for run in dataset)
        raise InvalidInputError(
            f"faults spoil measured contacts, but {lacking} of {len(dataset)} runs have no contact "
            f"field; it must be in every run"
        )
    lists = ReallocatingModel(model, dataset)
    detail = concatenated_details(
        [
            trajectory_detail(
                lists,
                dataset,
                number,
                steps,
                sensor or faults.sensor,
                _reported(run, faults, number) if known else None,
                motion_noise,
            )
            for number, run in enumerate(dataset)
            if run.steps >= steps
        ]
    )
    free, contact = _without_and_with_change(detail, detail.squared_error)
    still_free, still_contact = _without_and_with_change(detail, detail.constant_velocity)
    frozen = frozen_free = frozen_contact = None
    if detail.frozen_contact is not None:
        frozen = detail.rmse(detail.frozen_contact)
        frozen_free, frozen_contact = _without_and_with_change(detail, detail.frozen_contact)
    measured = _scores(detail, detail.edge_active, detail.touch_on_time)
    unmeasured = _scores(detail, detail.edge_active_unmeasured, detail.touch_on_time_unmeasured)
    inferred, inferred_error = _NOT_SCORED, None
    if detail.inferred is not None:
        inferred = _scores(detail, detail.inferred.edge_active, detail.inferred.touch_on_time)
        inferred_error = detail.rmse(detail.inferred.squared_error)
    finite = np.isfinite(detail.squared_error).all(axis=(1, 2))
    return OpenLoopMetrics(
        runs=len(dataset),
        windows=len(detail.run),
        n_steps=steps,
        diverged_windows=int(np.sum(~finite)),
        n_step_rmse_m=_required(detail.rmse(detail.squared_error)),
        n_step_rmse_moving_m=detail.rmse(detail.squared_error, detail.moves),
        n_step_rmse_free_m=free,
        n_step_rmse_contact_m=contact,
        n_step_rmse_unmeasured_m=_required(detail.rmse(detail.squared_error_unmeasured)),
        constant_velocity_rmse_m=_required(detail.rmse(detail.constant_velocity)),
        frozen_contact_rmse_m=frozen,
        constant_velocity_rmse_free_m=still_free,
        constant_velocity_rmse_contact_m=still_contact,
        frozen_contact_rmse_free_m=frozen_free,
        frozen_contact_rmse_contact_m=frozen_contact,
        edge_precision=measured.precision,
        edge_recall=measured.recall,
        edge_f1=measured.f1,
        edge_accuracy=measured.accuracy,
        edge_false_alarm_rate=measured.false_alarm_rate,
        switch_time_error_s=measured.switch_time_error_s,
        edge_on_time=measured.on_time,
        edge_precision_unmeasured=unmeasured.precision,
        edge_recall_unmeasured=unmeasured.recall,
        edge_f1_unmeasured=unmeasured.f1,
        edge_accuracy_unmeasured=unmeasured.accuracy,
        switch_time_error_unmeasured_s=unmeasured.switch_time_error_s,
        edge_on_time_unmeasured=unmeasured.on_time,
        n_step_rmse_inferred_m=inferred_error,
        edge_precision_inferred=inferred.precision,
        edge_recall_inferred=inferred.recall,
        edge_f1_inferred=inferred.f1,
        edge_accuracy_inferred=inferred.accuracy,
        switch_time_error_inferred_s=inferred.switch_time_error_s,
        edge_on_time_inferred=inferred.on_time,
        detail=detail,
    )


def _without_and_with_change(
    detail: OpenLoopDetail, squared: np.ndarray
) -> tuple[float | None, float | None]:
    """RMSE over the windows in which no contact changes, and over those in which one does."""
    if detail.contact_changes is None:
        return None, None
    return (
        detail.rmse(squared, ~detail.contact_changes),
        detail.rmse(squared, detail.contact_changes),
    )


def _steps(dataset: Dataset, horizon_s: float) -> int:
    longest = max(run.steps for run in dataset)
    steps = round(horizon_s / dataset.dt) if math.isfinite(horizon_s) else 0
    if not 1 <= steps <= longest:
        raise InvalidInputError(
            f"horizon_s must be {dataset.dt:g} to {longest * dataset.dt:g} s, from one step to "
            f"the longest run, found {horizon_s}"
        )
    return steps


def _reported(run: Trajectory, faults: SensorFaults, number: int) -> np.ndarray | None:
    return None if run.contact is None else faults.reported(run.contact, run.scene, number)


def _scores(detail: OpenLoopDetail, active: np.ndarray, on_time: np.ndarray) -> EdgeScores:
    if detail.contact is None:
        return _NOT_SCORED
    return edge_scores(active, detail.contact, detail.edge_exists, on_time, detail.dt)


def _required(value: float | None) -> float:
    """There is at least one window, and each has a node that is compared."""
    return math.nan if value is None else value
