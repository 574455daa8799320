"""The study of results: every data set beside its baselines, by what ``train`` chooses."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import choice
from contactgraph_studies.data_sets import (
    DATA_SETS,
    SCRIPTS,
    Amounts,
    DataSet,
    ResultCondition,
    Scenes,
    Source,
    result_measurements,
)
from contactgraph_studies.job import Job, JobRecords, Measurement, in_dependency_order
from contactgraph_studies.results import (
    PLAN_MS,
    SLOWEST_MS,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Values,
    moving_error,
    smallest,
)
from contactgraph_studies.runner import reason_missing
from contactgraph_studies.study import Study, StudyResult
from contactgraph_studies.tables import DASH, StudyTable, counts, number_text

_ALL = Quantity("n_step_rmse_m", null=math.inf)
_ALL_BY_MOTION = Quantity("n_step_rmse_inferred_m", null=math.inf)


def _cm(key: str) -> Quantity:
    return Quantity(key, "cm", 100.0)


def _degrees(key: str) -> Quantity:
    return Quantity(key, "degrees", 180.0 / math.pi)


def _by_motion(values: Values) -> float:
    """NaN where motion corrects no belief."""
    error = moving_error("n_step_rmse_moving_inferred_m", _ALL_BY_MOTION)
    return error.read(values) if values.get("infer_contacts", True) else math.nan


_BY_MOTION = Quantity("n_step_rmse_moving_inferred_m", "cm", derived=_by_motion)
QUANTITIES = {
    "measured_cm": (Source.model, moving_error("n_step_rmse_moving_m", _ALL)),
    "motion_cm": (Source.model, _BY_MOTION),
    "constant_velocity_cm": (Source.model, _cm("constant_velocity_rmse_moving_m")),
    "least_squares_cm": (Source.baselines, _cm("least_squares_rmse_moving_m")),
    "network_cm": (Source.baselines, _cm("gnn_rmse_moving_m")),
    "fixed_contact_cm": (Source.model, _cm("frozen_contact_rmse_moving_m")),
    "prior_touch_cm": (Source.prior_touch, _BY_MOTION),
    "prior_hold_cm": (Source.prior_hold, _BY_MOTION),
    "forced_cm": (Source.forced, _BY_MOTION),
    "forced_mean_cm": (Source.forced, _cm("n_step_mean_moving_inferred_m")),
    "forced_measured_cm": (Source.forced, moving_error("n_step_rmse_moving_m", _ALL)),
    "forced_prior_touch_cm": (Source.forced_prior_touch, _BY_MOTION),
    "forced_prior_hold_cm": (Source.forced_prior_hold, _BY_MOTION),
    "forced_f1": (Source.forced, Quantity("edge_f1_now_inferred")),
    "forced_calibration": (Source.forced, Quantity("calibration_error_inferred")),
    "forced_calibration_ahead": (Source.forced, Quantity("calibration_error_ahead_inferred")),
    "angle_degrees": (Source.model, _degrees("angle_rmse_rad")),
    "constant_velocity_angle_degrees": (Source.model, _degrees("constant_velocity_angle_rmse_rad")),
    "network_angle_degrees": (Source.baselines, _degrees("gnn_angle_rmse_rad")),
    "edge_f1_measured": (Source.model, Quantity("edge_f1_now")),
    "edge_f1_motion": (Source.model, Quantity("edge_f1_now_inferred")),
    "calibration_error": (Source.model, Quantity("calibration_error_inferred")),
    "rest_drift_mm": (Source.model, Quantity("rest_drift_m", "mm", 1000.0)),
    "pin_drift_mm": (Source.model, Quantity("pin_drift_m", "mm", 1000.0)),
    "turned_over_percent": (Source.model, Quantity("turned_over_accuracy", "%", 100.0)),
    "mass_error_percent": (Source.model, Quantity("mass_error_median", "%", 100.0)),
    "mass_coverage_percent": (Source.model, Quantity("mass_interval_coverage", "%", 100.0)),
    "success_percent": (Source.mpc, SUCCESS_PERCENT),
    "motion_success_percent": (Source.mpc_motion, SUCCESS_PERCENT),
    "prior_touch_success_percent": (Source.mpc_prior_touch, SUCCESS_PERCENT),
    "prior_hold_success_percent": (Source.mpc_prior_hold, SUCCESS_PERCENT),
    "failed_grasp_delay_ms": (Source.mpc, Quantity("failed_grasp_delay_ms_p50", "ms")),
    "lost_grasp_delay_ms": (Source.mpc, Quantity("break_delay_ms_p50", "ms")),
    "goal_cm": (Source.mpc, _cm("goal_distance_m_median")),
    "expert_percent": (Source.expert, SUCCESS_PERCENT),
    "fixed_start_percent": (Source.fixed_start, SUCCESS_PERCENT),
    "fixed_start_goal_cm": (Source.fixed_start, _cm("goal_distance_m_median")),
    "step_ms_p50": (Source.mpc, PLAN_MS),
    "step_ms_p99": (Source.mpc, SLOWEST_MS),
    "training_s": (Source.model, Quantity("training_s", "s")),
}
"""The numbers of a row: the kind of job that measures them, and the key in its output."""
_KEPT = {
    *("n_step_rmse_m", "n_step_rmse_inferred_m", "infer_contacts", "least_squares_missing"),
    *("episodes", "success_rate", "seed"),
}
_LEARNED = ("measured_cm", "motion_cm", "least_squares_cm", "network_cm")
_HEADINGS = {
    "row": "data",
    "measured_cm": "ours, contacts measured",
    "motion_cm": "ours, by motion",
    "constant_velocity_cm": "constant velocity",
    "least_squares_cm": "least squares",
    "network_cm": "network",
    "angle_degrees": "angle, degrees",
    "edge_f1_motion": "edge F1",
    "calibration_error": "calibration error",
    "_success": "success of MPC",
    "_expert": "expert",
    "_fixed_start": "fixed start",
    "step_ms_p50": "control step, ms",
    "training_s": "training, s",
}
CAPTION = (
    "Errors in cm over the bodies that move, 0.5 s ahead of every state of 40 recorded "
    "trajectories (seed 1000), by models of 60 trajectories (seed 0) without contact labels: the "
    "median of the trainings, with their range in brackets. With contacts measured a contact "
    "sensor corrects the beliefs up to a window's start; by motion the observed motion does. The "
    "network is an interaction network that is trained on the same data for as long as the first "
    "training. Edge F1 and calibration error are of beliefs by motion, "
    "about the step just made. Every controller is tested in the same scenes (seed 2000); the "
    "interval of 95 % is over scenes. Times are of two jobs at a time on two cores; later "
    "trainings of a process reuse compiled programs."
)


@dataclass(frozen=True)
class ResultsStudy(Study):
    """Every data set is shown; those of ``only`` are measured."""

    amounts: Amounts
    sets: Sequence[DataSet] = DATA_SETS
    only: tuple[str, ...] = ()
    """Slugs; empty: all."""

    keeps_readings = True

    def restricted(self, names: str) -> Self:
        """To a comma-separated list of data sets.

        Raises `InvalidInputError` for an unknown name, and if each of them lacks a package.
        """
        known = {data.slug: data for data in self.sets}
        chosen = [choice("--only", name.strip(), known) for name in names.split(",")]
        missing = [data.missing for data in chosen if data.missing is not None]
        if len(missing) == len(chosen):
            raise InvalidInputError(f"--only: {missing[0]}")
        return replace(self, only=tuple(data.slug for data in chosen))

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Of the chosen data sets whose packages are installed."""
        return self._measured([data for data in self.sets if self.measures(data)])

    def measures(self, data: DataSet) -> bool:
        """Whether the data set is among those to measure."""
        return not self.only or data.slug in self.only

    @property
    def kept_jobs(self) -> list[Job]:
        """Of the data sets that are not measured."""
        others = [data for data in self.sets if not self.measures(data)]
        return in_dependency_order(one.job for one in self._measured(others))

    @property
    def left_out(self) -> Sequence[str]:
        """The data sets that lack a package, each with the extra that installs it."""
        return [data.missing for data in self.sets if data.missing is not None]

    def _measured(self, sets: Sequence[DataSet]) -> list[Measurement]:
        return result_measurements([one for one in sets if one.missing is None], self.amounts)

    def rows(self, folder: Path) -> list["ResultRow"]:
        """All rows of the table, by the jobs that this version has done in the folder."""
        records = JobRecords(folder, version("contactgraph"))
        every = self._measured(self.sets)
        done = [one for one in every if records.seconds(one.job) is not None]
        results = Results.read(folder, done)
        return [
            ResultRow(data, scenes, every, results, records)
            for data in self.sets
            for scenes in data.scenes
        ]

    def result(self, folder: Path) -> StudyResult:
        """The table."""
        rows, amounts = self.rows(folder), self.amounts
        warning = " Quick: trainings are cut short, so these numbers are worth nothing."
        return StudyResult(
            title="Every data set beside its baselines",
            summary=CAPTION + (warning if amounts.quick else ""),
            tables=[results_table(rows)],
            amounts={
                "training_seeds": list(amounts.seeds),
                "training_runs": amounts.training_runs,
                "test_runs": amounts.test_runs,
                "episodes": amounts.episodes,
                "searched_episodes": amounts.searched_episodes,
                "quick": amounts.quick,
            },
            readings=list(map(_of_source, rows[0].results.to_json())),
        )


@dataclass(frozen=True)
class ResultRow:
    """A data set in some scenes, with everything that is known about it."""

    data: DataSet
    scenes: Scenes
    measurements: Sequence[Measurement]
    """Of all rows."""
    results: Results
    records: JobRecords

    @property
    def name(self) -> str:
        """The label of the row."""
        return self.data.row_name(self.scenes)

    def condition(self, source: Source) -> ResultCondition:
        """The labels of its numbers."""
        return ResultCondition(self.data.slug, self.scenes.slug, source)

    @cached_property
    def numbers(self) -> Mapping[str, SeedStatistic]:
        """By name of the column; a name ends with its unit, if it has one."""
        return {
            name: self.results.statistic(self.condition(source), quantity)
            for name, (source, quantity) in QUANTITIES.items()
        }

    def notes(self) -> Iterator[tuple[str, str]]:
        """What has nothing to show, and the reason."""
        if self.data.missing is not None:
            yield "all", self.data.missing
            return
        for one in self.measurements:
            condition = one.condition
            if (condition.data, condition.scenes) == (self.data.slug, self.scenes.slug):
                reason = reason_missing(one.job, self.records)
                if reason is not None:
                    trained = condition.source not in (Source.baselines, *SCRIPTS)
                    yield f"{condition.source}{f' {one.seed}' if trained else ''}", reason
        readings = self.results.readings(self.condition(Source.baselines))
        if readings and readings[0].values.get("least_squares_missing"):
            yield "least squares", readings[0].values["least_squares_missing"]
        if not self.data.controlled:
            yield "success", "nothing is controlled"
        if self.scenes.task is not None:
            yield "errors", f"see {self.data.slug}, whose models are controlled"

    @property
    def commands(self) -> dict[str, str]:
        """The commands that record, train and measure the first training; "" for none."""
        sources = {"evaluate": Source.model, "baselines": Source.baselines, "control": Source.mpc}
        found = dict.fromkeys(("collect", "train", *sources), "")
        for name, source in sources.items():
            condition = self.condition(source)
            job = next((one.job for one in self.measurements if one.condition == condition), None)
            if job is not None:
                training = job.needs[0]
                found["collect"] = training.needs[0].command
                found |= {"train": training.command, name: job.command}
        return {f"command_{name}": command for name, command in found.items()}


def _of_source(reading: dict[str, Any]) -> dict[str, Any]:
    """The reading with those values alone that the table has of such jobs."""
    kept = _KEPT | {each.key for source, each in QUANTITIES.values() if source == reading["source"]}
    return {**reading, "values": {k: v for k, v in reading["values"].items() if k in kept}}


def _cells(row: ResultRow) -> dict[str, Any]:
    """The row of the table, by name of the column."""
    sources = {"mpc": Source.mpc, "expert": Source.expert, "fixed_start": Source.fixed_start}
    successes = {
        name: row.results.success(row.condition(source)) for name, source in sources.items()
    }
    return {
        "row": row.name,
        "data": row.data.slug,
        "scenes": row.scenes.slug,
        "trainings": len(row.results.readings(row.condition(Source.model))),
        **row.numbers,
        "_bold": smallest({name: row.numbers[name].median for name in _LEARNED}),
        "_success": successes["mpc"] or DASH,
        "_expert": successes["expert"] or DASH,
        "_fixed_start": successes["fixed_start"] or DASH,
        **{
            key: value
            for name, one in successes.items()
            for key, value in counts(one, f"_{name}").items()
        },
        **row.commands,
    }


def results_table(rows: Sequence[ResultRow]) -> StudyTable:
    """One row for each data set and kind of scenes; the reasons for gaps stand below it."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for what, reason in row.notes():
            reasons.setdefault((row.name, reason), []).append(what)
    return StudyTable(
        title="Every data set",
        caption=CAPTION,
        headings=_HEADINGS,
        texts=dict.fromkeys(QUANTITIES, number_text),
        rows=[_cells(row) for row in rows],
        notes=[f"{row}: {', '.join(what)}: {reason}" for (row, reason), what in reasons.items()],
    )
