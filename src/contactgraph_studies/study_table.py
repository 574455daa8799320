"""The study's main table: every task, test condition and model, in Markdown and CSV."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph_studies.claims_error import PLANNED_ERROR, RECORDED_ERROR, planned
from contactgraph_studies.claims_graph import recorded
from contactgraph_studies.declared import (
    GIM_TEMP,
    Amounts,
    StudyModel,
    StudyTask,
    TestCondition,
)
from contactgraph_studies.page_table import PageTable, TableRow, markdown_table
from contactgraph_studies.plan_cells import Source, Where, conditions_of
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.success import Success, pooled_success
from contactgraph_studies.words import short, with_range


@dataclass(frozen=True)
class Row:
    """One model under one test condition; errors in cm."""

    task: str
    condition: TestCondition
    model: str
    planned: Figure
    """The paper's metric."""
    planned_moving: Figure
    recorded: Figure
    """Open loop."""
    recorded_moving: Figure
    constant_velocity: Figure
    """Floors on the same windows as ``planned``."""
    frozen_contact: Figure
    edge_f1: Figure
    """Planned against executed."""
    edge_f1_recorded: Figure
    success: Success | None
    """Planned anew every half second."""
    success_every_step: Success | None
    """Planned anew every step; of GIM-Temp alone."""
    plan_ms_p99: Figure
    """Of the latter."""

    @property
    def commands(self) -> tuple[str, str]:
        """Closed loop, open loop; of the first seed."""
        return self.planned.command, self.recorded.command


def rows(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> list[Row]:
    """In the order in which they are declared."""
    return [
        _row(results, task, condition, model)
        for task in tasks
        for condition in conditions_of(task, amounts)
        for model in task.models
    ]


def _row(results: Results, task: StudyTask, condition: TestCondition, model: StudyModel) -> Row:
    closed, opened = planned(task, model, condition), recorded(task, model, condition)
    every_step = Where(Source.every_step, task.name, GIM_TEMP.name, condition.name)
    every_step = every_step if model is GIM_TEMP else closed
    return Row(
        task=task.name,
        condition=condition,
        model=model.name,
        planned=results.error_cm(closed, PLANNED_ERROR),
        planned_moving=results.moving_error_cm(
            closed, "n_step_rmse_planned_moving_m", PLANNED_ERROR
        ),
        recorded=results.error_cm(opened, RECORDED_ERROR),
        recorded_moving=results.moving_error_cm(opened, "n_step_rmse_moving_m", RECORDED_ERROR),
        constant_velocity=results.number(closed, "constant_velocity_planned_rmse_m", 100.0),
        frozen_contact=results.number(closed, "frozen_contact_planned_rmse_m", 100.0),
        edge_f1=results.number(closed, "edge_f1_planned"),
        edge_f1_recorded=results.number(opened, "edge_f1"),
        success=pooled_success(results.readings(closed)),
        success_every_step=(
            pooled_success(results.readings(every_step)) if model is GIM_TEMP else None
        ),
        plan_ms_p99=results.number(every_step, "plan_ms_p99") if model is GIM_TEMP else Figure(()),
    )


def markdown_rows(table: Sequence[Row]) -> str:
    """For people: median (range over seeds)."""
    heads = (
        *("task", "scenes", "model", "N-step error, planned against executed, cm"),
        *("of moving bodies, cm", "open loop, cm", "floor: frozen contact, cm"),
        *("floor: constant velocity, cm", "edge F1 planned", "edge F1 recorded"),
        *("success, replanned every 0.5 s", "every step"),
    )
    return markdown_table(heads, [_texts(row) for row in table])


def page_table(table: Sequence[Row]) -> PageTable:
    """For the study's page."""
    return PageTable(
        slug="table",
        title="Every model",
        caption="N-step error: plans against what was executed, half a second ahead, over all "
        "bodies (the paper's metric); the floors are on the same windows. Open loop: recorded "
        "expert runs. Medians, with the range over training seeds in brackets; success with its "
        "95 % Wilson interval, the episodes of all seeds together. A row's commands show when the "
        "pointer rests on it.",
        heads=(
            *("Task", "Scenes", "Model", "N-step error, cm", "moving bodies, cm"),
            *("open loop, cm", "frozen contact, cm", "constant velocity, cm", "edge F1"),
            *("edge F1, recorded", "success", "success, replanned every step"),
        ),
        rows=[_texts(row) for row in table],
    )


def _texts(row: Row) -> TableRow:
    return TableRow(
        names=(row.task, row.condition.name, row.model),
        figures=(
            with_range(row.planned),
            with_range(row.planned_moving),
            with_range(row.recorded),
            short(row.frozen_contact.median),
            short(row.constant_velocity.median),
            with_range(row.edge_f1),
            with_range(row.edge_f1_recorded),
            "" if row.success is None else str(row.success),
            "" if row.success_every_step is None else str(row.success_every_step),
        ),
        commands=row.commands,
    )


def csv_rows(table: Sequence[Row]) -> str:
    """For programs: median, lowest and highest of every number, and the commands."""
    figures = {
        "planned_cm": lambda row: row.planned,
        "planned_moving_cm": lambda row: row.planned_moving,
        "recorded_cm": lambda row: row.recorded,
        "recorded_moving_cm": lambda row: row.recorded_moving,
        "frozen_contact_cm": lambda row: row.frozen_contact,
        "constant_velocity_cm": lambda row: row.constant_velocity,
        "edge_f1_planned": lambda row: row.edge_f1,
        "edge_f1_recorded": lambda row: row.edge_f1_recorded,
        "plan_ms_p99_every_step": lambda row: row.plan_ms_p99,
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ends = ("median", "low", "high")
    writer.writerow(
        [
            *("task", "scenes", "in_distribution", "model", "seeds"),
            *(f"{name}_{end}" for name in figures for end in ends),
            *("successes", "episodes", "successes_every_step", "episodes_every_step"),
            *("command_closed_loop", "command_open_loop"),
        ]
    )
    for row in table:
        numbers = [
            value
            for figure in (read(row) for read in figures.values())
            for value in ((figure.median, figure.low, figure.high) if figure.known else [""] * 3)
        ]
        counts = [
            value
            for one in (row.success, row.success_every_step)
            for value in (("", "") if one is None else (one.successes, one.episodes))
        ]
        begin = [row.task, row.condition.name, row.condition.in_distribution, row.model]
        writer.writerow([*begin, len(row.planned.values), *numbers, *counts, *row.commands])
    return text.getvalue()
