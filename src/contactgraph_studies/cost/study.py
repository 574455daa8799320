"""The study of learned costs: its claim, its targets, its table and its result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph.cli.tasks import Target
from contactgraph.viz import Metric
from contactgraph.viz.metric_table import short
from contactgraph_studies.cost.config import (
    PICKUP_COST,
    SCENE_SEED,
    CostAmounts,
    CostTask,
    CostTest,
    among_distractors,
    by_demonstrations,
    tests_of,
)
from contactgraph_studies.cost.figures import ENOUGH, cost_pictures, cost_scenes
from contactgraph_studies.cost.jobs import (
    control,
    cost_measurements,
    demonstrated,
    learning,
)
from contactgraph_studies.cost.known_answer import known_answer_table
from contactgraph_studies.job import Measurement
from contactgraph_studies.results import (
    CONTACT_SPEED,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Success,
    joined,
)
from contactgraph_studies.study import Claim, Study, StudyResult, judged
from contactgraph_studies.tables import StudyTable, counts, known_text

_PAPER = 0.98
_UNSEEN = Target(98.0, 100.0)
"""% of the episodes of all seeds."""
_AMONG_DISTRACTORS = Target(95.0, 100.0)
_LEARNING_S = Target(300.0, 60.0)
_FEW = 5.0
"""Demonstrations for a success of `ENOUGH`."""
_TOUCHED = Quantity("touched_bystanders")
_SECONDS = Quantity("made", derived=lambda values: float(values["made"]["seconds"]))
_OMITTED = ("history", "in_words")
"""Fields of a cost file that are long, or the same in all."""
_VERDICTS = {
    True: "the paper's claim holds",
    False: "the paper's claim does not hold",
    None: "whether the paper's claim holds is not known",
}


@dataclass(frozen=True)
class CostStudy(Study):
    """Costs learned from demonstrations of some tasks."""

    tasks: Sequence[CostTask]
    amounts: CostAmounts

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return cost_measurements(self.tasks, self.amounts)

    def result(self, folder: Path) -> StudyResult:
        """The claim, tables and figures."""
        results, amounts = Results.read(folder, self.measurements), self.amounts
        claim = transfers(results, self.tasks, amounts)
        shared = (folder, self.measurements, self.tasks, amounts)
        return StudyResult(
            title="A cost, learned from demonstrations",
            summary="A cost learned from an expert's runs through a differentiable LQR on "
            f"the learned model: {_VERDICTS[claim.holds]}. {len(amounts.seeds)} seed(s) of "
            f"demonstrations, each with one goal; {amounts.episodes} closed-loop episodes a seed, "
            "with goals and objects that no demonstration had.",
            claims=[claim],
            targets_heading="Targets of learned costs",
            targets=cost_targets(results, self.tasks, amounts),
            tables=[cost_table(results, self.tasks, amounts), known_answer_table(*shared)],
            figures=cost_pictures(results, *shared),
            scenes=cost_scenes(*shared),
            amounts={
                "demonstration_seeds": list(amounts.seeds),
                "demonstrations": list(amounts.demonstrations),
                "episodes": amounts.episodes,
                "test_scene_seeds": [SCENE_SEED + seed for seed in amounts.seeds],
            },
            readings=results.to_json(omit=_OMITTED),
        )


def transfers(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> Claim:
    """Claim 8: a learned cost does the task for goals and objects that were not demonstrated."""
    claim = Claim(
        8,
        "A cost learned from demonstrations of one goal does the task for unseen goals",
        "demonstrations collected by sampling the initial position of the gripper but "
        "keeping the goal and object locations fixed […] evaluate […] if it generalizes to unseen "
        "goal and object locations […] the learned controller can perform the task with 98% "
        "success rate",
        f"learned from {amounts.most} demonstrations, control succeeds in at least "
        f"{100 * _PAPER:.0f} % of the episodes of all seeds of {PICKUP_COST.name}, with unseen "
        "goals and objects (the paper has this task alone)",
        results,
        [task.name for task in tasks],
    )
    rates = {}
    for task in tasks:
        for test in by_demonstrations(amounts):
            name = f"success, {test.learned.demonstrations} demonstrations"
            claim.measure(name, task.name, "%", control(task, test), SUCCESS_PERCENT)
        success = results.success(control(task, by_demonstrations(amounts)[-1]))
        if success is not None:
            rates[task.name] = success.rate
            claim.findings.append(f"{success_text(success)} on {task.name}")
    own = rates.get(PICKUP_COST.name)
    claim.verdicts.append(None if own is None else own >= _PAPER)
    if claim.findings:
        found = joined(claim.findings)
        claim.sentence = f"Learned from {amounts.most} demonstrations: {found}."
    return claim


_HEADINGS = {
    "task": "Task",
    "learned_from": "Cost learned from",
    "demonstrations": "demonstrations",
    "distractors": "distractors in view",
    "seeds": "",
    "_success": "success (95 %)",
    "_each_seed": "each seed, %",
    "successes": "",
    "episodes": "",
    "interval_low": "",
    "interval_high": "",
    "success_percent": "",
    "contact_speed_m_s": "speed at contact, m/s",
    "touched_bystanders": "",
    "_touched": "episodes in which a distractor was touched",
    "learning_s": "learning, s",
    "command_learning": "",
    "command_control": "",
}


def cost_table(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> StudyTable:
    """Every cost in every kind of scene; the task's own cost comes last."""

    def row(task: CostTask, test: CostTest | None) -> dict[str, Any]:
        if test is None:
            learned_from, demonstrations, distractors = "not learned: the task's own cost", None, 0
            labels, seconds = demonstrated(task), SeedStatistic()
        else:
            learned_from, demonstrations = test.learned.name, test.learned.demonstrations
            labels, distractors = control(task, test), test.distractors
            seconds = results.statistic(learning(task, test.learned), _SECONDS)
        percent, success = results.statistic(labels, SUCCESS_PERCENT), results.success(labels)
        touched = results.statistic(labels, _TOUCHED)
        interval = (None, None) if success is None else success.interval
        return {
            "task": task.name,
            "learned_from": learned_from,
            "demonstrations": demonstrations,
            "distractors": distractors,
            "seeds": len(percent.values),
            "_success": success,
            "_each_seed": percent,
            **counts(success),
            "interval_low": interval[0],
            "interval_high": interval[1],
            "success_percent": percent,
            "contact_speed_m_s": results.statistic(labels, CONTACT_SPEED),
            "touched_bystanders": touched,
            "_touched": touched if distractors else SeedStatistic(),
            "learning_s": seconds,
            "command_learning": seconds.command,
            "command_control": percent.command,
        }

    return StudyTable(
        slug="table",
        title="Every cost",
        caption="Success in scenes whose goal and objects were in no demonstration: the episodes "
        "of all seeds together, with the 95 % Wilson interval, and each seed by itself. Each seed "
        "has demonstrations with a goal and objects of their own, and test scenes of its own, the "
        "same ones for every cost. Speeds are medians, with the range over seeds; seconds are on "
        "one core while another job runs on the other. The task's own cost is tested in the "
        "scenes of its demonstrations.",
        headings=_HEADINGS,
        texts={
            "_success": success_text,
            "_each_seed": _each_seed,
            "_touched": _each_seed,
            "learning_s": known_text,
        },
        rows=[row(task, test) for task in tasks for test in (*tests_of(task, amounts), None)],
    )


def success_text(success: Success | None) -> str:
    """Per cent, counts, and the interval of all episodes together."""
    if success is None:
        return "not known"
    low, high = (100.0 * end for end in success.interval)
    counts = f"{success.successes} of {success.episodes}"
    return f"{short(100.0 * success.rate)} % ({counts}; {short(low)} to {short(high)})"


def _each_seed(statistic: SeedStatistic) -> str:
    return ", ".join(short(value) for value in statistic.values)


def cost_targets(
    results: Results, tasks: Sequence[CostTask], amounts: CostAmounts
) -> tuple[Metric, ...]:
    """The targets of every task."""
    targets = []
    for task in tasks:
        most, among = by_demonstrations(amounts)[-1], among_distractors(amounts)
        tests = [(most, _UNSEEN), *((test, _AMONG_DISTRACTORS) for test in among)]
        targets += [_success_target(results, task, *each, amounts) for each in tests]
        targets.append(_demonstrations_target(results, task, amounts))
        seconds = results.statistic(learning(task, most.learned), _SECONDS)
        name = f"{task.name}: learning from {amounts.most} demonstrations, on one core"
        targets.append(judged(name, "s", seconds, _LEARNING_S, amounts.seeds, lower=True))
    return tuple(targets)


def _success_target(
    results: Results, task: CostTask, test: CostTest, target: Target, amounts: CostAmounts
) -> Metric:
    """Success of the episodes of all seeds together, with their Wilson interval."""
    labels = control(task, test)
    success, each = results.success(labels), results.statistic(labels, SUCCESS_PERCENT)
    name = f"{task.name}: success, unseen goals and objects, "
    name += f"{test.learned.demonstrations} demonstrations"
    if test.distractors:
        name += f" by the {test.learned.name}, {test.distractors} distractors in view"
    if success is not None:
        name += f" ({success.successes} of {success.episodes} episodes; "
        name += f"each seed: {_each_seed(each)} %)"
    number = judged(name, "%", each, target, amounts.seeds)
    if success is None:
        return number
    low, high = success.interval
    return replace(number, value=100.0 * success.rate, interval=(100.0 * low, 100.0 * high))


def _demonstrations_target(results: Results, task: CostTask, amounts: CostAmounts) -> Metric:
    """The fewest demonstrations from which on success is at least `ENOUGH`."""
    needed: list[float] = []
    command, missed = "", False
    for test in reversed(by_demonstrations(amounts)):
        readings = results.readings(control(task, test))
        success = results.success(control(task, test))
        missed = success is not None and success.rate < ENOUGH
        if success is None or missed:
            break
        needed, command = [test.learned.demonstrations], readings[0].command
    tried = ", ".join(str(count) for count in amounts.demonstrations)
    if missed and not needed:
        tried += ": not enough"
    name = f"{task.name}: demonstrations needed for {100 * ENOUGH:.0f} % (of {tried})"
    statistic = SeedStatistic(tuple(needed), command)
    number = judged(name, "", statistic, None, amounts.seeds, lower=True)
    return replace(number, aim=_FEW)
