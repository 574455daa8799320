"""The study of learned costs: its claim, its table, its figures and its result."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph.control import read_cost
from contactgraph.viz import cost_figure
from contactgraph.viz.metric_table import short
from contactgraph_studies.bootstrap import Verdict
from contactgraph_studies.cost.config import (
    SCENE_SEED,
    CostAmounts,
    CostTest,
    by_demonstrations,
    tests_of,
)
from contactgraph_studies.cost.jobs import (
    control,
    cost_measurements,
    demonstrated,
    learning,
)
from contactgraph_studies.cost.known_answer import known_answer_table
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper.config import PICKUP, StudyTask
from contactgraph_studies.results import (
    CONTACT_SPEED,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
)
from contactgraph_studies.study import Claim, Picture, Study, StudyResult, write_figure
from contactgraph_studies.tables import StudyTable, counts, number_text

_PAPER = 0.98
_TOUCHED = Quantity("touched_bystanders")
_SECONDS = Quantity("made", "s", derived=lambda values: float(values["made"]["seconds"]))
_OMITTED = ("history", "in_words")
"""Fields of a cost file that are long, or the same in all."""


@dataclass(frozen=True)
class CostStudy(Study):
    """Costs learned from demonstrations of some tasks."""

    tasks: Sequence[StudyTask]
    amounts: CostAmounts

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return cost_measurements(self.tasks, self.amounts)

    def result(self, folder: Path) -> StudyResult:
        """The claim, tables and figures."""
        results, amounts = Results.read(folder, self.measurements), self.amounts
        claim = transfers(results, self.tasks, amounts)
        answers = known_answer_table(folder, self.measurements, self.tasks, amounts)
        return StudyResult(
            title="A cost, learned from demonstrations",
            summary="A cost learned from an expert's runs through a differentiable LQR on "
            f"the learned model. The paper's claim: {claim.verdict.value}. {len(amounts.seeds)} "
            f"seed(s) of demonstrations, each with one goal; {amounts.episodes} closed-loop "
            "episodes a seed, with goals and objects that no demonstration had.",
            claims=[claim],
            tables=[cost_table(results, self.tasks, amounts), answers],
            figures=cost_pictures(folder, self.measurements, self.tasks, amounts),
            amounts={
                "demonstration_seeds": list(amounts.seeds),
                "demonstrations": list(amounts.demonstrations),
                "episodes": amounts.episodes,
                "test_scene_seeds": [SCENE_SEED + seed for seed in amounts.seeds],
            },
            readings=results.to_json(omit=_OMITTED),
        )


def transfers(results: Results, tasks: Sequence[StudyTask], amounts: CostAmounts) -> Claim:
    """Claim 8: a learned cost does the task for goals and objects that were not demonstrated."""
    claim = Claim(
        8,
        "A cost learned from demonstrations of one goal does the task for unseen goals",
        "demonstrations collected by sampling the initial position of the gripper but "
        "keeping the goal and object locations fixed […] evaluate […] if it generalizes to unseen "
        "goal and object locations […] the learned controller can perform the task with 98% "
        "success rate",
        f"learned from {amounts.most} demonstrations, control succeeds in at least "
        f"{100 * _PAPER:.0f} % of the episodes of all seeds of {PICKUP.name}, with unseen "
        "goals and objects (the paper has this task alone)",
        results,
        [task.name for task in tasks],
    )
    claim.verdicts = [Verdict.UNKNOWN]
    for task in tasks:
        for test in by_demonstrations(amounts):
            name = f"success, {test.learned.demonstrations} demonstrations"
            claim.measure(name, control(task, test), SUCCESS_PERCENT)
        success = results.success(control(task, by_demonstrations(amounts)[-1]))
        if success is not None:
            claim.findings.append(f"{task.name}, {amounts.most} demonstrations: {success}")
            if task.name == PICKUP.name:
                claim.verdicts = [Verdict.HOLDS if success.rate >= _PAPER else Verdict.FAILS]
    return claim


_HEADINGS = {
    "task": "Task",
    "learned_from": "Cost learned from",
    "demonstrations": "demonstrations",
    "distractors": "distractors in view",
    "_success": "success (95 %)",
    "_each_seed": "each seed, %",
    "contact_speed_m_s": "speed at contact, m/s",
    "_touched": "episodes in which a distractor was touched",
    "learning_s": "learning, s",
}


def cost_table(results: Results, tasks: Sequence[StudyTask], amounts: CostAmounts) -> StudyTable:
    """Every cost in every kind of scene; the task's own cost comes last."""

    def row(task: StudyTask, test: CostTest | None) -> dict[str, Any]:
        labels, seconds = demonstrated(task), SeedStatistic()
        if test is not None:
            labels = control(task, test)
            seconds = results.statistic(learning(task, test.learned), _SECONDS)
        percent, success = results.statistic(labels, SUCCESS_PERCENT), results.success(labels)
        touched = results.statistic(labels, _TOUCHED)
        interval = (None, None) if success is None else success.interval
        return {
            "task": task.name,
            "learned_from": test.learned.name if test else "not learned: the task's own cost",
            "demonstrations": test.learned.demonstrations if test else None,
            "distractors": test.distractors if test else 0,
            "seeds": len(percent.values),
            "_success": success or "not known",
            "_each_seed": percent,
            **counts(success),
            "interval_low": interval[0],
            "interval_high": interval[1],
            "success_percent": percent,
            "contact_speed_m_s": results.statistic(labels, CONTACT_SPEED),
            "touched_bystanders": touched,
            "_touched": touched if test and test.distractors else SeedStatistic(),
            "learning_s": seconds,
            "command_learning": seconds.command,
            "command_control": percent.command,
        }

    return StudyTable(
        title="Every cost",
        caption="Success in scenes whose goal and objects were in no demonstration: the episodes "
        "of all seeds together, with the 95 % Wilson interval, and each seed by itself. Each seed "
        "has demonstrations with a goal and objects of their own, and test scenes of its own, the "
        "same ones for every cost. Speeds are medians, with the range over seeds; seconds are on "
        "one core while another job runs on the other. The task's own cost is tested in the "
        "scenes of its demonstrations.",
        headings=_HEADINGS,
        texts={"_each_seed": _each_seed, "_touched": _each_seed, "learning_s": number_text},
        rows=[row(task, test) for task in tasks for test in (*tests_of(task, amounts), None)],
    )


def _each_seed(statistic: SeedStatistic) -> str:
    return ", ".join(short(value) for value in statistic.values)


def cost_pictures(
    folder: Path,
    measurements: Sequence[Measurement],
    tasks: Sequence[StudyTask],
    amounts: CostAmounts,
) -> list[Picture]:
    """The learned cost of each task, written to ``figures/NAME.png`` in the folder."""
    first_jobs = {one.condition: one.job for one in reversed(measurements)}
    pictures = []
    for task in tasks:
        job = first_jobs[learning(task, by_demonstrations(amounts)[-1].learned)]
        if (folder / job.output).is_file():
            title = f"The learned cost, {task.name}"
            caption = f"From {amounts.most} demonstrations with one goal, the first seed's."
            figure = cost_figure(read_cost(folder / job.output))
            pictures.append(write_figure(folder, f"cost-{task.name}", title, caption, figure))
    return pictures
