"""The study of inference: what a filter of contacts reaches, and what is lost without it."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from contactgraph.viz.figures import LEGEND, TEXT, new_figure, reliability_panel
from contactgraph_studies.figures import filter_figure, write_figure
from contactgraph_studies.inference_jobs import (
    COMMANDED,
    EXACT,
    FILTER,
    FIRST_FORM,
    HIDDEN,
    KNOWN,
    LATE,
    LYING,
    PRIORS,
    InferenceCondition,
    inference_measurements,
)
from contactgraph_studies.inference_rows import (
    CALIBRATION,
    F1,
    TOLD_FREE,
    TOLD_FREE_LATER,
    TRAINING_S,
    InferenceNumbers,
    InferenceRow,
    inference_rows,
)
from contactgraph_studies.job import JobRecords, Measurement
from contactgraph_studies.results import Quantity, Results, SeedStatistic, with_range
from contactgraph_studies.runner import reason_missing
from contactgraph_studies.study import Picture, StudyResult
from contactgraph_studies.tables import DASH, StudyTable, number_text
from contactgraph_studies.world_row import ERRORS, INFERRED, MEASURED
from contactgraph_studies.world_study import StudyOfWorlds
from contactgraph_studies.worlds import World, WorldTraining


class InferenceStudy(StudyOfWorlds):
    """Three trainings of each task, measured with their inference and without it."""

    def measured(self, worlds: Sequence[World]) -> list[Measurement]:
        """Predictions with every sensor and inference, and control."""
        return inference_measurements(worlds, self.amounts)

    def result(self, folder: Path) -> StudyResult:
        """Tables and figures."""
        amounts = self.amounts
        results, records = self.finished(folder)
        tasks = {one.slug: one.row_name(one.scenes[0]).split(",")[0] for one in self.worlds}
        rows = inference_rows(results, tasks)
        trained = {slug: name for slug, name in tasks.items() if slug in _TRAINED}
        warning = " Quick: trainings are cut short, so these numbers are worth nothing."
        figure = reliability_figure(results, trained)
        return StudyResult(
            title="Inference that infers",
            summary="A hidden Markov filter of the contact graph, trained without labels: "
            f"{len(amounts.seeds)} training seed(s), {amounts.training_runs} trajectories each, "
            f"{amounts.test_runs} to test on, {amounts.fast_episodes} controlled scenes. Two jobs "
            "ran at a time, each on one core." + (warning if amounts.quick else ""),
            tables=[
                self._numbers_table(rows, records),
                error_table(results, trained),
                belief_table(results, trained),
            ],
            figures=[
                *self._along_a_trajectory(folder),
                write_figure(folder, "reliability", "Reliability", _RELIABILITY_CAPTION, figure),
            ],
            amounts={
                "training_seeds": list(amounts.seeds),
                "training_runs": amounts.training_runs,
                "test_runs": amounts.test_runs,
                "episodes": amounts.fast_episodes,
                "quick": amounts.quick,
            },
            readings=results.to_json(),
        )

    def _along_a_trajectory(self, folder: Path) -> Iterator[Picture]:
        """The belief in a hold, of the first model that is trained on the shown task."""
        for world in self.worlds:
            if world.slug == _SHOWN:
                training = WorldTraining(world, self.amounts.seeds[0], self.amounts, FILTER)
                model = folder / training.model / "model.safetensors"
                test = training.evaluation(world.scenes[0]).arguments[2]
                figure = filter_figure(model, folder / test)
                if figure is not None:
                    title = f"One trajectory of {_SHOWN}"
                    yield write_figure(folder, "belief", title, _BELIEF_CAPTION, figure)

    def _numbers_table(self, rows: Sequence[InferenceRow], records: JobRecords) -> StudyTable:
        """Every number, and reasons for those that are not known."""
        return StudyTable(
            slug="table",
            title="Every number",
            caption="Median, with the lowest and the highest value in brackets. The floor is the "
            "error of the true masses with the true contact of the first step, on the same "
            "windows.",
            headings={name: name for name in ("what", "task", "measured")},
            texts={"measured": _with_unit},
            rows=[
                {
                    "what": row.what,
                    "task": row.task,
                    "measured": row.statistic,
                    "command": row.statistic.command,
                }
                for row in rows
            ],
            notes=list(dict.fromkeys(self._missing(rows, records))),
        )

    def _missing(self, rows: Sequence[InferenceRow], records: JobRecords) -> Iterator[str]:
        """A reason for every number that is not known."""
        every = self.measured(self.worlds)
        packages = {world.slug: world.missing for world in self.worlds}
        for row in rows:
            jobs = [one for one in every if one.condition in row.conditions]
            found = [
                packages[one.condition.task] or reason_missing(one.job, records) for one in jobs
            ]
            reasons = [reason for reason in found if reason is not None]
            if reasons:
                count = "" if len(reasons) == len(jobs) else f" ({len(reasons)} of {len(jobs)})"
                yield f"{row.task}: {jobs[0].condition.measured}{count}: {reasons[0]}"
            elif not row.statistic.known:
                yield f"{row.task}: {row.what}: its commands write no such number"


_UNCORRECTED = Quantity("n_step_rmse_moving_unmeasured_m", "cm", 100.0)
_SHOWN = "release"
_BELIEF_CAPTION = (
    "Belief in the hold of one pair, along a trajectory that no model has seen: corrected by the "
    "observed motion at every step, and never corrected. The band is the recorded hold. No contact "
    "is measured."
)
_TRAINED = (*HIDDEN, COMMANDED, *KNOWN)


def _with_unit(value: SeedStatistic) -> str:
    return with_range(value, value.unit) if value.known else DASH


def _table(
    slug: str,
    title: str,
    caption: str,
    headings: Mapping[str, str],
    rows: Mapping[str, Mapping[str, SeedStatistic]],
) -> StudyTable:
    """One row for each task."""
    return StudyTable(
        slug=slug,
        title=title,
        caption=caption,
        headings={"task": "task", **headings},
        texts=dict.fromkeys(headings, number_text),
        rows=[
            {
                "task": name,
                **numbers,
                "command": next((one.command for one in numbers.values() if one.command), ""),
            }
            for name, numbers in rows.items()
        ],
    )


def error_table(results: Results, tasks: Mapping[str, str]) -> StudyTable:
    """Errors of the filter, of everything in its place and of its sensors."""
    numbers = InferenceNumbers(results)
    columns = {
        **{"filter_inferred": "filter, by motion alone", "filter": "filter, contacts measured"},
        "filter_uncorrected": "filter, never corrected",
        **{"floor": "floor (frozen true contact)", "constant_velocity": "constant velocity"},
        **{"network": "interaction network (one fit)", "first_form": "first form, measured"},
        **{one.slug: one.name for one in (*PRIORS, LYING, LATE)},
    }

    def row(slug: str) -> dict[str, SeedStatistic]:
        measured = ERRORS[MEASURED]
        return {
            "filter_inferred": numbers.statistic(slug, ERRORS[INFERRED]),
            "filter": numbers.statistic(slug, measured),
            "filter_uncorrected": numbers.statistic(slug, _UNCORRECTED),
            "floor": numbers.statistic(slug, ERRORS["frozen_contact_cm"]),
            "constant_velocity": numbers.statistic(slug, ERRORS["constant_velocity_cm"]),
            "network": numbers.statistic(slug, ERRORS["gnn_cm"]),
            "first_form": numbers.statistic(slug, measured, model=FIRST_FORM),
            **{one.slug: numbers.statistic(slug, measured, one) for one in (*PRIORS, LYING, LATE)},
        }

    caption = (
        "cm over the bodies that move, 0.5 s ahead: median over trainings and their range. "
        "Contacts are measured from the first form on. The interaction network has the time of one "
        "training of the filter, and is fitted once."
    )
    rows = {name: row(slug) for slug, name in tasks.items()}
    return _table("errors", "Errors", caption, columns, rows)


def belief_table(results: Results, tasks: Mapping[str, str]) -> StudyTable:
    """Edge scores, calibration and what a sensor's report is worth."""
    numbers = InferenceNumbers(results)
    quantities = {
        "edge F1, by motion alone": F1[INFERRED],
        "edge F1, measured": F1[MEASURED],
        **{f"calibration error, {when}": one for when, one in CALIBRATION.items()},
        "told free: next step": TOLD_FREE,
        "told free: 0.5 s later": TOLD_FREE_LATER,
        "training, s": TRAINING_S,
    }
    return _table(
        "beliefs",
        "Beliefs",
        "Edge F1 is that of the step just made. The calibration error is the expected one, ten "
        "bins, of beliefs corrected by motion alone. Told free: belief in contact after ten "
        "reports of none, while touching at rest.",
        {name: name for name in quantities},
        {
            name: {key: numbers.statistic(slug, one) for key, one in quantities.items()}
            for slug, name in tasks.items()
        },
    )


_RELIABILITY_CAPTION = (
    "Share of active edges against belief, ten bins, beliefs corrected by motion alone; all "
    "trainings together. Bins with fewer than 20 beliefs are left out; a calibrated belief lies on "
    "the diagonal."
)
_AHEAD = {
    "reliability_inferred": "one step ahead",
    "reliability_ahead_inferred": "ten steps ahead",
}
_LEAST_BELIEFS = 20


def reliability_figure(results: Results, tasks: Mapping[str, str]) -> Figure:
    """One panel for each task."""
    figure = new_figure(9.0, 4.8)
    panels = figure.subplots(
        2, -(-max(len(tasks), 2) // 2), sharex=True, sharey=True, squeeze=False
    )
    for axes in panels.flat[len(tasks) :]:
        axes.set_visible(False)
    for axes, (slug, name) in zip(panels.flat, tasks.items(), strict=False):
        readings = list(results.readings(InferenceCondition(slug, FILTER.name, EXACT.name)))
        found = {
            label: [bins for one in readings if (bins := one.values.get(key))]
            for key, label in _AHEAD.items()
        }
        reliability_panel(axes, name, {label: _bins(bins) for label, bins in found.items()})
    figure.supxlabel("belief", **TEXT)
    figure.supylabel("share of active edges", **TEXT)
    handles, labels = panels.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, **LEGEND)
    return figure


def _bins(found: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Mean belief and share of active edges of each bin, over trainings.

    Each of ``found`` is [10, 3]: count, mean belief and share, both null in an empty bin.
    """
    bins = np.asarray(found, float).reshape(-1, 10, 3)  # null: NaN
    count = bins[..., 0].sum(axis=0)
    sums = np.nansum(bins[..., :1] * bins[..., 1:], axis=0)
    means = sums[count >= _LEAST_BELIEFS] / count[count >= _LEAST_BELIEFS, None]
    return means[:, 0], means[:, 1]
