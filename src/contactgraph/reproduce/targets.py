"""What GIM-Temp must reach on each task, beside what it reaches."""

from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph.reproduce.claims_error import PLANNED_ERROR, planned
from contactgraph.reproduce.claims_graph import recorded
from contactgraph.reproduce.declared import (
    DOOR,
    GIM_TEMP,
    MULTI_PICKUP,
    PICKUP,
    StudyTask,
    TestCondition,
)
from contactgraph.reproduce.plan_cells import Source, Where
from contactgraph.reproduce.results import Figure, Results
from contactgraph.view import Number


@dataclass(frozen=True)
class Asked:
    """Of one number."""

    at_least: float
    aim: float | None = None


EDGE_F1 = {True: Asked(0.97, 0.995), False: Asked(0.95, 0.995)}
"""By whether the scenes are like those of training; so are the next two."""
SUCCESS_PERCENT = {True: Asked(98.0, 100.0), False: Asked(95.0, 100.0)}
_ERROR_CM = {
    PICKUP.name: {True: Asked(0.4, 0.2), False: Asked(0.3, 0.1)},
    MULTI_PICKUP.name: {True: Asked(1.0, 0.3), False: Asked(1.5, 0.5)},
    DOOR.name: {True: Asked(1.0, 0.3), False: Asked(1.2, 0.3)},
}


def asked_error_cm(task: StudyTask, condition: TestCondition) -> Asked | None:
    """Of the N-step error; None for scenes that nothing is asked of."""
    if condition not in (task.as_trained, task.hardest):
        return None
    return _ERROR_CM[task.name][condition.in_distribution]


def targets(
    results: Results, tasks: Sequence[StudyTask], seeds: tuple[int, ...]
) -> tuple[Number, ...]:
    """Every row of the table of targets; each is judged by its median over the seeds."""
    numbers = []
    for task in tasks:
        for condition in (task.as_trained, task.hardest):
            inside = condition.in_distribution
            label = f"{task.name}, {condition.name}"
            where = planned(task, GIM_TEMP, condition)
            every_step = Where(Source.every_step, task.name, GIM_TEMP.name, condition.name)
            f1 = results.number(where, "edge_f1_planned")
            f1_recorded = results.number(recorded(task, GIM_TEMP, condition), "edge_f1")
            success = results.number(every_step, "success_rate", 100.0)
            numbers += [
                _number(
                    f"{label}: N-step error, planned against executed",
                    "cm",
                    results.error_cm(where, PLANNED_ERROR),
                    asked_error_cm(task, condition),
                    seeds,
                    lower_is_better=True,
                ),
                _number(f"{label}: edge F1, the same", "", f1, EDGE_F1[inside], seeds),
                _number(f"{label}: edge F1, recorded", "", f1_recorded, EDGE_F1[inside], seeds),
                _number(f"{label}: success", "%", success, SUCCESS_PERCENT[inside], seeds),
            ]
    return tuple(numbers)


def _number(
    name: str,
    unit: str,
    figure: Figure,
    asked: Asked | None,
    seeds: tuple[int, ...],
    lower_is_better: bool = False,
) -> Number:
    return Number(
        name=name,
        value=figure.median if figure.known else None,
        unit=unit,
        interval=(figure.low, figure.high) if len(figure.values) > 1 else None,
        at_least=None if asked is None else asked.at_least,
        aim=None if asked is None else asked.aim,
        lower_is_better=lower_is_better,
        command=figure.command,
        seed=seeds,
    )
