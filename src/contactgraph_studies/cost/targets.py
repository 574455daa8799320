"""What learned costs must reach, beside what they reach."""

from collections.abc import Sequence

from contactgraph.viz import Number
from contactgraph_studies.cost.cells import Controlled
from contactgraph_studies.cost.declared import (
    CostAmounts,
    CostTask,
    Trial,
    among_distractors,
    by_runs,
)
from contactgraph_studies.cost.table import learning_seconds
from contactgraph_studies.results import Results
from contactgraph_studies.success import pooled_success
from contactgraph_studies.targets import Asked, judged
from contactgraph_studies.words import short

_UNSEEN = Asked(98.0, 100.0)
"""Per cent of the episodes of all seeds."""
_AMONG_DISTRACTORS = Asked(95.0, 100.0)
_LEARNING_S = Asked(300.0, 60.0)
ENOUGH = 0.95
"""The success whose price in demonstrations is asked for …"""
_FEW = 5.0
"""… and what it should be."""


def cost_targets(
    results: Results, tasks: Sequence[CostTask], amounts: CostAmounts
) -> tuple[Number, ...]:
    """Every row of the table of targets."""
    numbers = []
    for task in tasks:
        learned = by_runs(amounts)[-1]
        seconds = learning_seconds(results, task, learned.lesson)
        numbers += [
            _success(results, task, learned, amounts, _UNSEEN),
            *(
                _success(results, task, trial, amounts, _AMONG_DISTRACTORS)
                for trial in among_distractors(amounts)
            ),
            _demonstrations_needed(results, task, amounts),
            judged(
                f"{task.name}: learning from {amounts.most} demonstrations, on one core",
                "s",
                seconds,
                _LEARNING_S,
                amounts.seeds,
                lower_is_better=True,
            ),
        ]
    return tuple(numbers)


def _success(
    results: Results, task: CostTask, trial: Trial, amounts: CostAmounts, asked: Asked
) -> Number:
    """Of the episodes of all seeds together, with their Wilson interval."""
    readings = results.readings(Controlled(task.name, trial))
    pooled = pooled_success(readings)
    scenes = f"unseen goals and objects, {trial.lesson.runs} demonstrations"
    if trial.distractors:
        scenes += f" by the {trial.lesson.name}, {trial.distractors} distractors in view"
    name = f"{task.name}: success, {scenes}"
    interval = None
    if pooled is not None:
        each = ", ".join(short(100.0 * reading.values["success_rate"]) for reading in readings)
        name += f" ({pooled.successes} of {pooled.episodes} episodes; each seed: {each} %)"
        interval = (100.0 * pooled.interval[0], 100.0 * pooled.interval[1])
    return Number(
        name=name,
        value=None if pooled is None else 100.0 * pooled.share,
        unit="%",
        interval=interval,
        at_least=asked.at_least,
        aim=asked.aim,
        command=readings[0].command if readings else "",
        seed=amounts.seeds,
    )


def _demonstrations_needed(results: Results, task: CostTask, amounts: CostAmounts) -> Number:
    """The fewest from which on every number of demonstrations is enough."""
    needed, command, missed = None, "", False
    for trial in reversed(by_runs(amounts)):
        readings = results.readings(Controlled(task.name, trial))
        pooled = pooled_success(readings)
        missed = pooled is not None and pooled.share < ENOUGH
        if pooled is None or missed:
            break
        needed, command = trial.lesson.runs, readings[0].command
    tried = ", ".join(str(runs) for runs in amounts.runs)
    if needed is None and missed:
        tried += ": not enough"
    return Number(
        name=f"{task.name}: demonstrations needed for {100 * ENOUGH:.0f} % (of {tried})",
        value=needed,
        aim=_FEW,
        lower_is_better=True,
        command=command,
        seed=amounts.seeds,
    )
