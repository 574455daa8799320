"""The study of models: its table, its targets and its result."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from contactgraph.viz import Number
from contactgraph_studies.job import Job, Measurement, in_dependency_order
from contactgraph_studies.paper.claims import claims
from contactgraph_studies.paper.config import (
    FRANKA,
    GIM_TEMP,
    Amounts,
    StudyModel,
    StudyTask,
    TestCondition,
)
from contactgraph_studies.paper.figures import figure_pictures, scene_pictures
from contactgraph_studies.paper.jobs import (
    CONSTANT_VELOCITY,
    EDGE_F1,
    FIXED_CONTACT,
    PLANNED_ERROR,
    RECORDED_ERROR,
    ModelCondition,
    Source,
    conditions_of,
    measurements,
    planned,
    recorded,
)
from contactgraph_studies.results import (
    CONTACT_SPEED,
    PLANNED_F1,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Success,
    Values,
)
from contactgraph_studies.study import StudyResult, judged
from contactgraph_studies.tables import Column, StudyTable, median_text

_PLAN_MS = Quantity("plan_ms_p99")


@dataclass(frozen=True)
class ModelStudy:
    """The models of the paper on some tasks."""

    tasks: Sequence[StudyTask]
    amounts: Amounts

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return measurements(self.tasks, self.amounts)

    @cached_property
    def jobs(self) -> list[Job]:
        """All jobs in dependency order."""
        return in_dependency_order(one.job for one in self.measurements)

    def result(self, folder: Path) -> StudyResult:
        """Claims, tables and figures."""
        results = Results.read(folder, self.measurements)
        judged_claims = claims(results, self.tasks, self.amounts)
        hold = sum(claim.holds is True for claim in judged_claims)
        figures = figure_pictures(folder, results, self.tasks, self.amounts)
        scenes, parameters = scene_pictures(folder, self.tasks, self.measurements)
        return StudyResult(
            title="A contact graph, claim by claim",
            summary=f"The paper's claims, measured again: {hold} of {len(judged_claims)} claims "
            f"hold for our models. {len(self.amounts.seeds)} training seed(s), "
            f"{self.amounts.episodes} closed-loop episodes for each model and condition, in scenes "
            "that are in no training data.",
            claims=judged_claims,
            targets_heading="Targets of GIM-Temp",
            targets=model_targets(results, self.tasks, self.amounts.seeds),
            tables=[model_table(results, self.tasks, self.amounts)],
            figures=[*figures, *parameters],
            scenes=scenes,
            amounts={
                "training_seeds": list(self.amounts.seeds),
                "test_runs": self.amounts.test_runs,
                "episodes": self.amounts.episodes,
                "success_episodes": self.amounts.success_episodes,
            },
            readings=results.to_json("training_seed"),
        )


class Row(NamedTuple):
    """A row of the table."""

    task: StudyTask
    scenes: TestCondition
    model: StudyModel

    @property
    def planned(self) -> ModelCondition:
        """Closed loop, replanned every half second."""
        return planned(*self._in_order)

    @property
    def recorded(self) -> ModelCondition:
        """Open loop."""
        return recorded(*self._in_order)

    @property
    def every_step(self) -> ModelCondition:
        """Closed loop, replanned every step; of GIM-Temp alone."""
        return ModelCondition(Source.every_step, self.task.name, self.model.name, self.scenes.name)

    @property
    def _in_order(self) -> tuple[StudyTask, StudyModel, TestCondition]:
        return self.task, self.model, self.scenes


def model_table(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> StudyTable:
    """Every model on every task under every test condition."""

    def statistic(source: str, quantity: Quantity) -> Callable[[Row], SeedStatistic]:
        return lambda row: results.statistic(getattr(row, source), quantity)

    def moving(source: str, key: str, of_all: Quantity) -> Callable[[Row], SeedStatistic]:
        """Null means infinite if the error of all bodies is, else that nothing moved."""

        def value(values: Values) -> float:
            error, every = values.get(key), values.get(of_all.key)
            if error is None:
                return math.inf if every is None else math.nan
            return 100.0 * error

        return lambda row: results.derived(getattr(row, source), value)

    def success(source: str) -> Callable[[Row], Success | None]:
        return lambda row: results.success(getattr(row, source))

    def count(source: str, field: str) -> Callable[[Row], int | None]:
        return lambda row: getattr(results.success(getattr(row, source)), field, None)

    def commands(row: Row) -> tuple[str, str]:
        return (
            results.statistic(row.planned, PLANNED_ERROR).command,
            results.statistic(row.recorded, RECORDED_ERROR).command,
        )

    planned_error = statistic("planned", PLANNED_ERROR)
    return StudyTable.measure(
        slug="table",
        title="Every model",
        caption="N-step error: planned against executed positions, half a second ahead, over all "
        "bodies (the paper's metric); the baselines are on the same windows. Open loop: recorded "
        "expert runs. Medians, with the range over training seeds in brackets; success with its "
        "95 % Wilson interval, the episodes of all seeds together. A row's commands show when the "
        "pointer rests on it.",
        columns=[
            Column(lambda row: row.task.name, "task", "Task", "task", label=True),
            Column(lambda row: row.scenes.name, "scenes", "Scenes", "scenes", label=True),
            Column(lambda row: row.scenes.in_distribution, "in_distribution"),
            Column(lambda row: row.model.name, "model", "Model", "model", label=True),
            Column(lambda row: len(planned_error(row).values), "seeds"),
            Column(
                planned_error,
                "planned_cm",
                "N-step error, cm",
                "N-step error, planned against executed, cm",
            ),
            Column(
                moving("planned", "n_step_rmse_planned_moving_m", PLANNED_ERROR),
                "planned_moving_cm",
                "moving bodies, cm",
                "of moving bodies, cm",
            ),
            Column(statistic("recorded", RECORDED_ERROR), "recorded_cm", "open loop, cm"),
            Column(
                moving("recorded", "n_step_rmse_moving_m", RECORDED_ERROR), "recorded_moving_cm"
            ),
            Column(
                statistic("planned", FIXED_CONTACT),
                "frozen_contact_cm",
                "fixed contact, cm",
                "baseline: fixed contact, cm",
                median_text,
            ),
            Column(
                statistic("planned", CONSTANT_VELOCITY),
                "constant_velocity_cm",
                "constant velocity, cm",
                "baseline: constant velocity, cm",
                median_text,
            ),
            Column(
                statistic("planned", PLANNED_F1), "edge_f1_planned", "edge F1", "edge F1 planned"
            ),
            Column(
                statistic("recorded", EDGE_F1),
                "edge_f1_recorded",
                "edge F1, recorded",
                "edge F1 recorded",
            ),
            Column(statistic("every_step", _PLAN_MS), "plan_ms_p99_every_step"),
            Column(success("planned"), "", "success", "success, replanned every 0.5 s"),
            Column(success("every_step"), "", "success, replanned every step", "every step"),
            Column(count("planned", "successes"), "successes"),
            Column(count("planned", "episodes"), "episodes"),
            Column(count("every_step", "successes"), "successes_every_step"),
            Column(count("every_step", "episodes"), "episodes_every_step"),
            Column(lambda row: commands(row)[0], "command_closed_loop"),
            Column(lambda row: commands(row)[1], "command_open_loop"),
        ],
        conditions=[
            Row(task, condition, model)
            for task in tasks
            for condition in conditions_of(task, amounts)
            for model in task.models
        ],
        commands=commands,
    )


def model_targets(
    results: Results, tasks: Sequence[StudyTask], seeds: Sequence[int]
) -> tuple[Number, ...]:
    """The targets of GIM-Temp; each is judged by the median over seeds."""
    return tuple(one for task in tasks for one in _task_targets(results, task, seeds))


def _task_targets(results: Results, task: StudyTask, seeds: Sequence[int]) -> Iterator[Number]:
    targets = task.known.targets
    for condition in (task.as_trained, task.hardest):
        row = Row(task, condition, GIM_TEMP)
        label, inside = f"{task.name}, {condition.name}", condition.in_distribution
        error = results.statistic(row.planned, PLANNED_ERROR)
        f1 = results.statistic(row.planned, PLANNED_F1)
        f1_recorded = results.statistic(row.recorded, EDGE_F1)
        success = results.statistic(row.every_step, SUCCESS_PERCENT)
        yield judged(
            f"{label}: N-step error, planned against executed",
            "cm",
            error,
            task.known.error_target_cm(condition),
            seeds,
            lower_is_better=True,
        )
        yield judged(f"{label}: edge F1, the same", "", f1, targets.edge_f1[inside], seeds)
        yield judged(f"{label}: edge F1, recorded", "", f1_recorded, targets.edge_f1[inside], seeds)
        yield judged(f"{label}: success", "%", success, targets.success_percent[inside], seeds)
        if task is FRANKA:  # the other tasks' reports judge these
            speed = results.statistic(row.every_step, CONTACT_SPEED)
            yield judged(f"{label}: speed at contact", "m/s", speed, targets.contact_speed, seeds)
            yield judged(
                f"{label}: control tick, 99 %, both cores busy",
                "ms",
                results.statistic(row.every_step, _PLAN_MS),
                targets.tick_ms,
                seeds,
                lower_is_better=True,
            )
