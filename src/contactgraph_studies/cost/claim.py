"""The paper's claim about learned costs."""

from collections.abc import Sequence

from contactgraph_studies.claim import Claim, ClaimNumber, verdict
from contactgraph_studies.cost.cells import Controlled
from contactgraph_studies.cost.declared import PICKUP_COST, CostAmounts, CostTask, by_runs
from contactgraph_studies.cost.table import success_words
from contactgraph_studies.results import Results
from contactgraph_studies.success import Success, pooled_success
from contactgraph_studies.words import joined

_PAPER = 0.98
_NUMBER = 8
"""Behind the seven about models."""


def transfers(results: Results, tasks: Sequence[CostTask], amounts: CostAmounts) -> Claim:
    """That a learned cost does the task for goals and objects that no demonstration had."""
    numbers: list[ClaimNumber] = []
    reached: dict[str, Success] = {}
    for task in tasks:
        for trial in by_runs(amounts):
            where = Controlled(task.name, trial)
            success = results.number(where, "success_rate", 100.0)
            name = f"success, {trial.lesson.runs} demonstrations"
            numbers.append(ClaimNumber(name, task.name, "%", success))
        most = Controlled(task.name, by_runs(amounts)[-1])
        pooled = pooled_success(results.readings(most))
        if pooled is not None:
            reached[task.name] = pooled
    own = reached.get(PICKUP_COST.name)
    said = [f"{success_words(success)} on {name}" for name, success in reached.items()]
    return Claim(
        number=_NUMBER,
        title="A cost learned from demonstrations of one goal does the task for unseen goals",
        quote="demonstrations collected by sampling the initial position of the gripper but "
        "keeping the goal and object locations fixed […] evaluate […] if it generalizes to unseen "
        "goal and object locations […] the learned controller can perform the task with 98% "
        "success rate",
        criterion=f"learned from {amounts.most} demonstrations, control succeeds in at least "
        f"{100 * _PAPER:.0f} % of the episodes of all seeds of {PICKUP_COST.name}, with unseen "
        "goals and objects (the paper has this task alone)",
        tasks=tuple(task.name for task in tasks),
        numbers=tuple(numbers),
        holds=verdict([None if own is None else own.share >= _PAPER]),
        sentence=f"Learned from {amounts.most} demonstrations: {joined(said)}."
        if said
        else "Not measured.",
    )
