"""The study's main table: how control with every learned cost goes, in Markdown and CSV."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph_studies.cost.cells import Controlled, Demonstrated, Learned, Place
from contactgraph_studies.cost.declared import CostAmounts, CostTask, Lesson, trials
from contactgraph_studies.page_table import PageTable, TableRow
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.success import Success, pooled_success
from contactgraph_studies.words import short, with_range


@dataclass(frozen=True)
class CostRow:
    """One cost in one kind of scene."""

    task: str
    lesson: Lesson | None
    """None: the task's own cost."""
    distractors: int
    success: Success | None
    success_percent: Figure
    """Of every seed."""
    contact_speed: Figure
    """Median of the episodes, m/s."""
    touched: Figure
    """Episodes in which a bystander was touched, of each seed."""
    seconds: Figure
    """Of learning."""

    @property
    def learned_from(self) -> str:
        """In words."""
        return "not learned: the task's own cost" if self.lesson is None else self.lesson.name


def cost_rows(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> list[CostRow]:
    """In the order in which they are declared; the task's own cost is each task's last."""
    found = []
    for task in tasks:
        for trial in trials(task, amounts):
            where = Controlled(task.name, trial)
            found.append(_row(results, where, task, trial.lesson, trial.distractors))
        found.append(_row(results, Demonstrated(task.name), task, None, 0))
    return found


def _row(
    results: Results, where: Place, task: CostTask, lesson: Lesson | None, distractors: int
) -> CostRow:
    learned = Figure(()) if lesson is None else learning_seconds(results, task, lesson)
    return CostRow(
        task=task.name,
        lesson=lesson,
        distractors=distractors,
        success=pooled_success(results.readings(where)),
        success_percent=results.number(where, "success_rate", 100.0),
        contact_speed=results.number(where, "contact_speed_m_s"),
        touched=results.number(where, "touched_bystanders"),
        seconds=learned,
    )


def learning_seconds(results: Results, task: CostTask, lesson: Lesson) -> Figure:
    """How long learning took, s; of every seed."""
    where = Learned(task.name, lesson)
    return results.derived(where, lambda values: float(values["made"]["seconds"]))


def success_words(success: Success) -> str:
    """Per cent, counts, and the interval of all episodes together."""
    low, high = (100.0 * end for end in success.interval)
    counts = f"{success.successes} of {success.episodes}"
    return f"{short(100.0 * success.share)} % ({counts}; {short(low)} to {short(high)})"


def cost_table(table: Sequence[CostRow]) -> PageTable:
    """For the study's page."""
    return PageTable(
        slug="table",
        title="Every cost",
        caption="Success in scenes whose goal and objects were in no demonstration: the episodes "
        "of all seeds together, with the 95 % Wilson interval, and each seed by itself. Each seed "
        "has demonstrations with a goal and objects of their own, and test scenes of its own, the "
        "same ones for every cost. Speeds are medians, with the range over seeds; seconds are on "
        "one core while another cell runs on the other. The task's own cost is tested in the "
        "scenes of its demonstrations.",
        heads=(
            *("Task", "Cost learned from", "demonstrations", "distractors in view"),
            *("success (95 %)", "each seed, %", "speed at contact, m/s"),
            *("episodes in which a bystander was touched", "learning, s"),
        ),
        rows=[_texts(row) for row in table],
    )


def _texts(row: CostRow) -> TableRow:
    runs = "" if row.lesson is None else str(row.lesson.runs)
    return TableRow(
        names=(row.task, row.learned_from, runs, str(row.distractors)),
        figures=(
            "not known" if row.success is None else success_words(row.success),
            ", ".join(short(value) for value in row.success_percent.values),
            with_range(row.contact_speed),
            ", ".join(short(value) for value in row.touched.values) if row.distractors else "",
            with_range(row.seconds) if row.seconds.known else "",
        ),
        commands=(row.seconds.command, row.success_percent.command),
    )


def cost_csv(table: Sequence[CostRow]) -> str:
    """For programs: counts, interval, lowest and highest of the seeds, and the commands."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    figures = ("success_percent", "contact_speed_m_s", "touched_bystanders", "learning_s")
    writer.writerow(
        [
            *("task", "learned_from", "demonstrations", "distractors", "seeds"),
            *("successes", "episodes", "interval_low", "interval_high"),
            *(f"{name}_{end}" for name in figures for end in ("median", "low", "high")),
            *("command_learning", "command_control"),
        ]
    )
    for row in table:
        runs = "" if row.lesson is None else row.lesson.runs
        begin = [row.task, row.learned_from, runs, row.distractors]
        counts: list[object] = [""] * 4
        if row.success is not None:
            counts = [row.success.successes, row.success.episodes, *row.success.interval]
        numbers = [
            value
            for figure in (row.success_percent, row.contact_speed, row.touched, row.seconds)
            for value in ((figure.median, figure.low, figure.high) if figure.known else [""] * 3)
        ]
        commands = (row.seconds.command, row.success_percent.command)
        seeds = len(row.success_percent.values)
        writer.writerow([*begin, seeds, *counts, *numbers, *commands])
    return text.getvalue()
