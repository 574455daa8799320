"""The study of models: its tables and its result."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from contactgraph.envs.registry import TestCondition
from contactgraph.viz.metric_table import short
from contactgraph_studies.bootstrap import Verdict
from contactgraph_studies.job import JobRecords, Measurement
from contactgraph_studies.paper.claims import claims
from contactgraph_studies.paper.config import Amounts, StudyModel, StudyTask
from contactgraph_studies.paper.figures import figure_pictures, parameter_pictures
from contactgraph_studies.paper.jobs import (
    CONSTANT_VELOCITY,
    EDGE_F1,
    FIXED_CONTACT,
    PLANNED_BY_EPISODE,
    PLANNED_ERROR,
    RECORDED_BY_RUN,
    RECORDED_ERROR,
    Source,
    condition_of,
    measurements,
)
from contactgraph_studies.results import PLANNED_F1, SLOWEST_MS, Results
from contactgraph_studies.study import Claim, Study, StudyResult
from contactgraph_studies.tables import StudyTable, counts

OMITTED = (
    *("reliability", "calibration", "brier", "log_score", "_inferred", "_free_", "_by_type"),
    *("least_squares", "gnn", "standing_still", "angle", "_delay_ms", "slowest_before", "mass_"),
)
"""Parts of keys that nothing here reads."""


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
        return StudyResult(
            title="A contact graph, claim by claim",
            summary="The paper's claims, measured again with the paper's own models, with models "
            f"of the same form that are cared for, and with ours: {_count(judged_claims)}. "
            f"{len(amounts.seeds)} training(s) of each model, {amounts.episodes} closed-loop "
            "episodes for each training and condition, in scenes that are in no training data.",
            claims=judged_claims,
            tables=[
                model_table(results, self.tasks, amounts),
                verdict_table(judged_claims),
            ],
            figures=[
                *figure_pictures(folder, results, self.tasks),
                *parameter_pictures(folder, self.tasks, self.measurements),
            ],
            amounts={
                "training_seeds": list(amounts.seeds),
                "test_runs": amounts.test_runs,
                "episodes": amounts.episodes,
                "success_episodes": amounts.success_episodes,
                "redrawn_networks": JobRecords(folder, version("contactgraph")).redrawn(self.jobs),
            },
            readings=results.to_json("training_seed", OMITTED),
        )


def _count(judged_claims: Sequence[Claim]) -> str:
    families = Counter(claim.family for claim in judged_claims)
    hold = Counter(one.family for one in judged_claims if one.verdict is Verdict.HOLDS)
    return "; ".join(f"{name} {hold[name]} of {count} hold" for name, count in families.items())


def verdict_table(judged_claims: Sequence[Claim]) -> StudyTable:
    """A row for each claim, a column for each family."""
    families = dict.fromkeys(claim.family for claim in judged_claims)
    rows: dict[int, dict[str, Any]] = {}
    for claim in judged_claims:
        row = rows.setdefault(claim.number, {"claim": f"{claim.number}. {claim.title}"})
        row[claim.family] = claim.verdict.value
    headings = {name: name for name in ("claim", *families)}
    return StudyTable(
        title="Verdicts",
        caption="Of each family of models. A claim holds if the 95 % intervals, over trainings and "
        "scenes, of all that it asks lie within its bounds on every task; it does not hold if one "
        "lies outside; else it cannot be told.",
        headings=headings,
        rows=[dict.fromkeys(headings) | row for row in rows.values()],
    )


_HEADINGS = {
    "task": "task",
    "scenes": "scenes",
    "model": "model",
    "planned_moving_cm": "N-step error of moving bodies, planned against executed, cm",
    "planned_cm": "of all bodies, cm",
    "recorded_moving_cm": "open loop, moving bodies, cm",
    "recorded_cm": "of all bodies, cm",
    "frozen_contact_cm": "baseline: fixed contact, cm",
    "constant_velocity_cm": "baseline: constant velocity, cm",
    "edge_f1_planned": "edge F1 planned",
    "edge_f1_recorded": "edge F1 recorded",
    "_success": "success, replanned every 0.5 s",
    "_success_every_step": "every step",
}


def model_table(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> StudyTable:
    """Every model on every task under every test condition."""
    get = results.statistic

    def row(task: StudyTask, scenes: TestCondition, model: StudyModel) -> dict[str, Any]:
        sources = (Source.planned, Source.recorded, Source.every_step)
        closed, opened, every_step = (condition_of(one, task, model, scenes) for one in sources)
        error, open_loop = get(closed, PLANNED_ERROR), get(opened, RECORDED_ERROR)
        success, success_every_step = results.success(closed), results.success(every_step)
        return {
            "task": task.name,
            "scenes": scenes.name,
            "in_distribution": scenes == task.as_trained,
            "model": model.name,
            "seeds": len(error.values),
            "planned_moving_cm": get(closed, PLANNED_BY_EPISODE),
            "planned_cm": error,
            "recorded_moving_cm": get(opened, RECORDED_BY_RUN),
            "recorded_cm": open_loop,
            "frozen_contact_cm": get(closed, FIXED_CONTACT),
            "constant_velocity_cm": get(closed, CONSTANT_VELOCITY),
            "edge_f1_planned": get(closed, PLANNED_F1),
            "edge_f1_recorded": get(opened, EDGE_F1),
            "plan_ms_p99_every_step": get(every_step, SLOWEST_MS),
            "_success": success,
            "_success_every_step": success_every_step,
            **counts(success),
            **counts(success_every_step, "_every_step"),
            "command_closed_loop": error.command,
            "command_open_loop": open_loop.command,
        }

    baselines = ("frozen_contact_cm", "constant_velocity_cm")
    return StudyTable(
        title="Every model",
        caption="N-step error: planned against executed positions, half a second ahead, over the "
        "bodies that move and over all (the paper's metric); the baselines are over all, on the "
        "same windows. Those of moving bodies are root mean squares over episodes, as in the "
        "claims; an episode in which no object moves has none. Open loop: recorded expert runs. "
        "Medians, with the range over training seeds in brackets. Success: every "
        "training seed, in the same scenes, with the 95 % Wilson interval of the median one over "
        "these scenes. A row's commands show when the pointer rests on it.",
        headings=_HEADINGS,
        texts=dict.fromkeys(baselines, lambda one: short(one.median)),
        rows=[
            row(task, scenes, model)
            for task in tasks
            for scenes in task.conditions
            for model in task.models
        ],
    )
