"""The study of learned costs: its claim, its targets, its table and its result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from contactgraph.cli.tasks import Target
from contactgraph.viz import Number
from contactgraph.viz.number_table import short
from contactgraph_studies.cost.config import (
    PICKUP_COST,
    SCENE_SEED,
    CostAmounts,
    CostCondition,
    CostTask,
    CostTest,
    among_distractors,
    by_demonstrations,
    tests_of,
)
from contactgraph_studies.cost.figures import ENOUGH, cost_pictures, cost_scenes
from contactgraph_studies.cost.jobs import (
    OwnCostLabels,
    control,
    cost_measurements,
    demonstrated,
    learning,
)
from contactgraph_studies.cost.known_answer import known_answer_table
from contactgraph_studies.job import Job, Measurement, in_dependency_order
from contactgraph_studies.results import (
    CONTACT_SPEED,
    SUCCESS_PERCENT,
    Quantity,
    Results,
    SeedStatistic,
    Success,
    joined,
)
from contactgraph_studies.study import Claim, Evidence, StudyResult, judged
from contactgraph_studies.tables import Column, StudyTable, known_text

_PAPER = 0.98
_UNSEEN = Target(98.0, 100.0)
"""% of the episodes of all seeds."""
_AMONG_DISTRACTORS = Target(95.0, 100.0)
_LEARNING_S = Target(300.0, 60.0)
_FEW = 5.0
"""Demonstrations for a success of `ENOUGH`."""
_TOUCHED = Quantity("touched_bystanders")
_OMITTED = ("history", "in_words")
"""Fields of a cost file that are long, or the same in all."""
_VERDICTS = {
    True: "the paper's claim holds",
    False: "the paper's claim does not hold",
    None: "whether the paper's claim holds is not known",
}


@dataclass(frozen=True)
class CostStudy:
    """Costs learned from demonstrations of some tasks."""

    tasks: Sequence[CostTask]
    amounts: CostAmounts

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return cost_measurements(self.tasks, self.amounts)

    @cached_property
    def jobs(self) -> list[Job]:
        """All jobs in dependency order."""
        return in_dependency_order(one.job for one in self.measurements)

    def result(self, folder: Path) -> StudyResult:
        """The claim, tables and figures."""
        results = Results.read(folder, self.measurements)
        claim = transfers(results, self.tasks, self.amounts)
        shared = (folder, self.measurements, self.tasks, self.amounts)
        seeds, episodes = self.amounts.seeds, self.amounts.episodes
        return StudyResult(
            title="A cost, learned from demonstrations",
            summary="A cost learned from an expert's runs through a differentiable LQR on "
            f"the learned model: {_VERDICTS[claim.holds]}. {len(seeds)} seed(s) of demonstrations, "
            f"each with one goal; {episodes} closed-loop episodes a seed, with goals and objects "
            "that no demonstration had.",
            claims=[claim],
            targets_heading="Targets of learned costs",
            targets=cost_targets(results, self.tasks, self.amounts),
            tables=[cost_table(results, self.tasks, self.amounts), known_answer_table(*shared)],
            figures=cost_pictures(results, *shared),
            scenes=cost_scenes(*shared),
            amounts={
                "demonstration_seeds": list(seeds),
                "demonstrations": list(self.amounts.demonstrations),
                "episodes": episodes,
                "test_scene_seeds": [SCENE_SEED + seed for seed in seeds],
            },
            readings=results.to_json(omit=_OMITTED),
        )


def transfers(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> Claim:
    """Claim 8: a learned cost does the task for goals and objects that were not demonstrated."""
    found = Evidence([task.name for task in tasks])
    rates = {}
    for task in tasks:
        for test in by_demonstrations(amounts):
            rate = results.statistic(control(task, test), SUCCESS_PERCENT)
            found.add(
                f"success, {test.learned.demonstrations} demonstrations", task.name, "%", rate
            )
        success = results.success(control(task, by_demonstrations(amounts)[-1]))
        if success is not None:
            rates[task.name] = success.rate
            found.sentences.append(f"{success_text(success)} on {task.name}")
    own = rates.get(PICKUP_COST.name)
    found.verdicts.append(None if own is None else own >= _PAPER)
    return found.claim(
        number=8,
        title="A cost learned from demonstrations of one goal does the task for unseen goals",
        quote="demonstrations collected by sampling the initial position of the gripper but "
        "keeping the goal and object locations fixed […] evaluate […] if it generalizes to unseen "
        "goal and object locations […] the learned controller can perform the task with 98% "
        "success rate",
        criterion=f"learned from {amounts.most} demonstrations, control succeeds in at least "
        f"{100 * _PAPER:.0f} % of the episodes of all seeds of {PICKUP_COST.name}, with unseen "
        "goals and objects (the paper has this task alone)",
        sentence=f"Learned from {amounts.most} demonstrations: {joined(found.sentences)}."
        if found.sentences
        else "",
    )


class Row(NamedTuple):
    """A row of the table; without a test: the task's own cost."""

    task: CostTask
    test: CostTest | None

    @property
    def labels(self) -> OwnCostLabels:
        """Of control."""
        return demonstrated(self.task) if self.test is None else control(self.task, self.test)

    @property
    def learned_from(self) -> str:
        """The demonstrator."""
        own = "not learned: the task's own cost"
        return own if self.test is None else self.test.learned.name

    @property
    def demonstrations(self) -> int | None:
        """The number learned from."""
        return None if self.test is None else self.test.learned.demonstrations

    @property
    def distractors(self) -> int:
        """In the scenes of control."""
        return 0 if self.test is None else self.test.distractors


def cost_table(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> StudyTable:
    """Every cost in every kind of scene; the task's own cost comes last."""

    def statistic(quantity: Quantity) -> Callable[[Row], SeedStatistic]:
        return lambda row: results.statistic(row.labels, quantity)

    def success(row: Row) -> Success | None:
        return results.success(row.labels)

    def count(field: str) -> Callable[[Row], int | None]:
        return lambda row: getattr(success(row), field, None)

    def interval(end: int) -> Callable[[Row], float | None]:
        return lambda row: None if (one := success(row)) is None else one.interval[end]

    def seconds(row: Row) -> SeedStatistic:
        if row.test is None:
            return SeedStatistic()
        return learning_seconds(results, row.task, row.test.learned)

    def commands(row: Row) -> tuple[str, str]:
        return seconds(row).command, results.statistic(row.labels, SUCCESS_PERCENT).command

    rate, touched = statistic(SUCCESS_PERCENT), statistic(_TOUCHED)
    return StudyTable.measure(
        slug="table",
        title="Every cost",
        caption="Success in scenes whose goal and objects were in no demonstration: the episodes "
        "of all seeds together, with the 95 % Wilson interval, and each seed by itself. Each seed "
        "has demonstrations with a goal and objects of their own, and test scenes of its own, the "
        "same ones for every cost. Speeds are medians, with the range over seeds; seconds are on "
        "one core while another job runs on the other. The task's own cost is tested in the "
        "scenes of its demonstrations.",
        columns=[
            Column(lambda row: row.task.name, "task", "Task", label=True),
            Column(lambda row: row.learned_from, "learned_from", "Cost learned from", label=True),
            Column(lambda row: row.demonstrations, "demonstrations", "demonstrations", label=True),
            Column(lambda row: row.distractors, "distractors", "distractors in view", label=True),
            Column(lambda row: len(rate(row).values), "seeds"),
            Column(success, "", "success (95 %)", text=success_text),
            Column(rate, "", "each seed, %", text=_each_seed),
            Column(count("successes"), "successes"),
            Column(count("episodes"), "episodes"),
            Column(interval(0), "interval_low"),
            Column(interval(1), "interval_high"),
            Column(rate, "success_percent"),
            Column(statistic(CONTACT_SPEED), "contact_speed_m_s", "speed at contact, m/s"),
            Column(touched, "touched_bystanders"),
            Column(
                lambda row: touched(row) if row.distractors else SeedStatistic(),
                "",
                "episodes in which a distractor was touched",
                text=_each_seed,
            ),
            Column(seconds, "learning_s", "learning, s", text=known_text),
            Column(lambda row: commands(row)[0], "command_learning"),
            Column(lambda row: commands(row)[1], "command_control"),
        ],
        conditions=[Row(task, test) for task in tasks for test in (*tests_of(task, amounts), None)],
        commands=commands,
    )


def learning_seconds(results: Results, task: CostTask, learned: CostCondition) -> SeedStatistic:
    """Wall time of learning, s."""
    labels = learning(task, learned)
    return results.derived(labels, lambda values: float(values["made"]["seconds"]))


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
) -> tuple[Number, ...]:
    """The targets of every task."""
    numbers = []
    for task in tasks:
        most = by_demonstrations(amounts)[-1]
        numbers += [
            _success_target(results, task, most, amounts, _UNSEEN),
            *(
                _success_target(results, task, test, amounts, _AMONG_DISTRACTORS)
                for test in among_distractors(amounts)
            ),
            _demonstrations_target(results, task, amounts),
            judged(
                f"{task.name}: learning from {amounts.most} demonstrations, on one core",
                "s",
                learning_seconds(results, task, most.learned),
                _LEARNING_S,
                amounts.seeds,
                lower_is_better=True,
            ),
        ]
    return tuple(numbers)


def _success_target(
    results: Results, task: CostTask, test: CostTest, amounts: CostAmounts, asked: Target
) -> Number:
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
    number = judged(name, "%", each, asked, amounts.seeds)
    if success is None:
        return number
    low, high = success.interval
    return replace(number, value=100.0 * success.rate, interval=(100.0 * low, 100.0 * high))


def _demonstrations_target(results: Results, task: CostTask, amounts: CostAmounts) -> Number:
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
    number = judged(name, "", statistic, None, amounts.seeds, lower_is_better=True)
    return replace(number, aim=_FEW)
