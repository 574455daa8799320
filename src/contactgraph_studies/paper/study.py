"""The study of models: its table, its targets and its result."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

from contactgraph.cli.tasks import TestCondition
from contactgraph.viz import Number
from contactgraph.viz.number_table import short
from contactgraph_studies import tables
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper.claims import claims
from contactgraph_studies.paper.config import FRANKA, GIM_TEMP, Amounts, StudyModel, StudyTask
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
)
from contactgraph_studies.results import (
    CONTACT_SPEED,
    PLANNED_F1,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Values,
)
from contactgraph_studies.study import Study, StudyResult, judged
from contactgraph_studies.tables import label, statistic

_PLAN_MS = Quantity("plan_ms_p99")


@dataclass(frozen=True)
class ModelStudy(Study):
    """The models of the paper on some tasks."""

    tasks: Sequence[StudyTask]
    amounts: Amounts

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return measurements(self.tasks, self.amounts)

    def result(self, folder: Path) -> StudyResult:
        """Claims, tables and figures."""
        amounts, results = self.amounts, Results.read(folder, self.measurements)
        judged_claims = claims(results, self.tasks, amounts)
        hold = sum(claim.holds is True for claim in judged_claims)
        scenes, parameters = scene_pictures(folder, self.tasks, self.measurements)
        return StudyResult(
            title="A contact graph, claim by claim",
            summary=f"The paper's claims, measured again: {hold} of {len(judged_claims)} claims "
            f"hold for our models. {len(amounts.seeds)} training seed(s), "
            f"{amounts.episodes} closed-loop episodes for each model and condition, in scenes "
            "that are in no training data.",
            claims=judged_claims,
            targets_heading="Targets of GIM-Temp",
            targets=model_targets(results, self.tasks, amounts.seeds),
            tables=[model_table(results, self.tasks, amounts)],
            figures=[*figure_pictures(folder, results, self.tasks, amounts), *parameters],
            scenes=scenes,
            amounts={
                "training_seeds": list(amounts.seeds),
                "test_runs": amounts.test_runs,
                "episodes": amounts.episodes,
                "success_episodes": amounts.success_episodes,
            },
            readings=results.to_json("training_seed"),
        )


def _moving_cm(values: Values, key: str, of_all: Quantity) -> float:
    """An error of moving bodies; null is infinite only if the error of all bodies is."""
    if values[key] is None:
        return math.inf if values.get(of_all.key) is None else math.nan
    return 100.0 * values[key]


def _moving(key: str, of_all: Quantity) -> Quantity:
    return Quantity(key, derived=partial(_moving_cm, key=key, of_all=of_all))


def _row(results: Results, task: StudyTask, scenes: TestCondition, model: StudyModel) -> tables.Row:
    sources = ("planned", "recorded", "every_step")
    names = (task.name, model.name, scenes.name)
    conditions = {name: ModelCondition(Source(name), *names) for name in sources}
    seeds = len(results.statistic(conditions["planned"], PLANNED_ERROR).values)
    labels = {
        "task": task.name,
        "scenes": scenes.name,
        "in_distribution": scenes.in_distribution,
        "model": model.name,
        "seeds": seeds,
    }
    return tables.Row(labels, results, conditions)


def model_table(
    results: Results, tasks: Sequence[StudyTask], amounts: Amounts
) -> tables.StudyTable:
    """Every model on every task under every test condition."""
    error = "N-step error, planned against executed, cm"
    fixed, constant = "baseline: fixed contact, cm", "baseline: constant velocity, cm"
    moving = _moving("n_step_rmse_planned_moving_m", PLANNED_ERROR)
    moving_recorded = _moving("n_step_rmse_moving_m", RECORDED_ERROR)
    return tables.StudyTable.of(
        slug="table",
        title="Every model",
        caption="N-step error: planned against executed positions, half a second ahead, over all "
        "bodies (the paper's metric); the baselines are on the same windows. Open loop: recorded "
        "expert runs. Medians, with the range over training seeds in brackets; success with its "
        "95 % Wilson interval, the episodes of all seeds together. A row's commands show when the "
        "pointer rests on it.",
        columns=[
            label("task", "task"),
            label("scenes", "scenes"),
            label("in_distribution"),
            label("model", "model"),
            label("seeds"),
            statistic("planned_cm", error, "planned", PLANNED_ERROR),
            statistic("planned_moving_cm", "of moving bodies, cm", "planned", moving),
            statistic("recorded_cm", "open loop, cm", "recorded", RECORDED_ERROR),
            statistic("recorded_moving_cm", "", "recorded", moving_recorded),
            statistic("frozen_contact_cm", fixed, "planned", FIXED_CONTACT, _median),
            statistic("constant_velocity_cm", constant, "planned", CONSTANT_VELOCITY, _median),
            statistic("edge_f1_planned", "edge F1 planned", "planned", PLANNED_F1),
            statistic("edge_f1_recorded", "edge F1 recorded", "recorded", EDGE_F1),
            statistic("plan_ms_p99_every_step", "", "every_step", _PLAN_MS),
            tables.success("success, replanned every 0.5 s", "planned"),
            tables.success("every step", "every_step"),
            *tables.counts("planned"),
            *tables.counts("every_step", "_every_step"),
            tables.command("command_closed_loop", "planned", PLANNED_ERROR),
            tables.command("command_open_loop", "recorded", RECORDED_ERROR),
        ],
        rows=[
            _row(results, task, scenes, model)
            for task in tasks
            for scenes in conditions_of(task, amounts)
            for model in task.models
        ],
    )


def _median(one: SeedStatistic) -> str:
    return short(one.median)


def model_targets(
    results: Results, tasks: Sequence[StudyTask], seeds: Sequence[int]
) -> tuple[Number, ...]:
    """The targets of GIM-Temp; each is judged by the median over seeds."""
    return tuple(one for task in tasks for one in _task_targets(results, task, seeds))


def _task_targets(results: Results, task: StudyTask, seeds: Sequence[int]) -> Iterator[Number]:
    targets = task.known.targets
    for scenes in (task.as_trained, task.hardest):
        row, inside = _row(results, task, scenes, GIM_TEMP), scenes.in_distribution
        error_target, f1_target = task.known.error_target_cm(scenes), targets.edge_f1[inside]
        error = row.statistic("planned", PLANNED_ERROR)
        f1 = row.statistic("planned", PLANNED_F1)
        f1_recorded = row.statistic("recorded", EDGE_F1)
        success = row.statistic("every_step", SUCCESS_PERCENT)
        speed = row.statistic("every_step", CONTACT_SPEED)
        time = row.statistic("every_step", _PLAN_MS)
        label = f"{task.name}, {scenes.name}: "
        name = f"{label}N-step error, planned against executed"
        yield judged(name, "cm", error, error_target, seeds, lower=True)
        yield judged(f"{label}edge F1, the same", "", f1, f1_target, seeds)
        yield judged(f"{label}edge F1, recorded", "", f1_recorded, f1_target, seeds)
        yield judged(f"{label}success", "%", success, targets.success_percent[inside], seeds)
        if task is FRANKA:  # the other tasks' reports judge these
            name = f"{label}control tick, 99 %, both cores busy"
            yield judged(f"{label}speed at contact", "m/s", speed, targets.contact_speed, seeds)
            yield judged(name, "ms", time, targets.tick_ms, seeds, lower=True)
