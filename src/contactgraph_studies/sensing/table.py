"""The study's table: every sensor under every condition."""

import csv
import io
from collections.abc import Sequence

from contactgraph_studies.page_table import PageTable, TableRow
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.sensing.declared import SensingTask, sensors_of
from contactgraph_studies.sensing.results import Sensed, delay_ms
from contactgraph_studies.success import pooled_success
from contactgraph_studies.words import with_range

_NAMES = ("Task", "Condition", "Contacts known by")
_FIGURES = (
    *("success (95 %)", "edge F1", "onset delay, ms: median", "95 %"),
    *("planned error, cm", "edge F1, planned", "control tick, ms"),
)


def sensing_table(results: Results, tasks: Sequence[SensingTask]) -> PageTable:
    """For the study's page."""
    rows = []
    for where in _every(tasks):
        success = pooled_success(results.readings(where))
        figures = _figures(results, where)
        rows.append(
            TableRow(
                names=(where.task, where.condition, where.sensor),
                figures=(
                    "not known" if success is None else str(success),
                    *(with_range(figure) if figure.known else "" for figure in figures),
                ),
                commands=(figures[0].command,),
            )
        )
    return PageTable(
        slug="table",
        title="Every sensor",
        caption="Median over seeds of scenes, with their range; success of all episodes together. "
        "Edge F1: beliefs about the step just made, corrected by all that was observed, against "
        "contacts. Delay: from the first observation at which a contact holds to the first at "
        "which it is believed. Planned: over 0.5 s, plans against what came of them. An infinite "
        "delay is a contact that was never found.",
        heads=(*_NAMES, *_FIGURES),
        rows=rows,
    )


def sensing_csv(results: Results, tasks: Sequence[SensingTask]) -> str:
    """For programs: medians, lowest and highest over seeds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [f"{name} {end}" for name in _FIGURES[1:] for end in ("median", "low", "high")]
    writer.writerow([*_NAMES, "successes", "episodes", *heads, "command"])
    for where in _every(tasks):
        success = pooled_success(results.readings(where))
        counts = ["", ""] if success is None else [success.successes, success.episodes]
        figures = _figures(results, where)
        numbers = [
            value
            for figure in figures
            for value in ((figure.median, figure.low, figure.high) if figure.known else [""] * 3)
        ]
        names = (where.task, where.condition, where.sensor)
        writer.writerow([*names, *counts, *numbers, figures[0].command])
    return text.getvalue()


def _figures(results: Results, where: Sensed) -> list[Figure]:
    return [
        results.number(where, "edge_f1_found"),
        delay_ms(results, where, "onset_delay_ms_p50"),
        delay_ms(results, where, "onset_delay_ms_p95"),
        results.number(where, "n_step_rmse_planned_m", 100.0),
        results.number(where, "edge_f1_planned"),
        results.number(where, "plan_ms_p50"),
    ]


def _every(tasks: Sequence[SensingTask]) -> list[Sensed]:
    return [
        Sensed(task.name, condition.name, sensor.name)
        for task in tasks
        for condition in task.conditions
        for sensor in sensors_of(condition)
    ]
