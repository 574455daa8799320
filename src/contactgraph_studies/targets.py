"""What GIM-Temp must reach on each task, beside what it reaches."""

from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph.viz import Number
from contactgraph_studies.claims_error import PLANNED_ERROR, planned
from contactgraph_studies.claims_graph import recorded
from contactgraph_studies.declared import (
    DOOR,
    FRANKA,
    GIM_TEMP,
    MULTI_PICKUP,
    PICKUP,
    StudyTask,
    TestCondition,
)
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Figure, Results


@dataclass(frozen=True)
class Asked:
    """Of one number."""

    at_least: float
    aim: float | None = None


ByScene = dict[bool, Asked]
"""By whether the scenes are like those of training."""


@dataclass(frozen=True)
class TaskTargets:
    """What is asked of one task."""

    error_cm: ByScene
    """The N-step error."""
    edge_f1: ByScene
    success_percent: ByScene
    contact_speed: Asked = Asked(0.3)
    """Median, m/s."""
    training_s: Asked = Asked(120.0, 30.0)
    tick_ms: Asked = Asked(10.0, 3.0)
    """99 %, in the hardest scenes."""
    as_it_passes: bool = False
    """Whether the study judges speed at contact and the tick too; a report does for every task."""


_PLANAR_F1 = {True: Asked(0.97, 0.995), False: Asked(0.95, 0.995)}
_PLANAR_SUCCESS = {True: Asked(98.0, 100.0), False: Asked(95.0, 100.0)}
TARGETS = {
    PICKUP.name: TaskTargets(
        {True: Asked(0.4, 0.2), False: Asked(0.3, 0.1)}, _PLANAR_F1, _PLANAR_SUCCESS
    ),
    MULTI_PICKUP.name: TaskTargets(
        {True: Asked(1.0, 0.3), False: Asked(1.5, 0.5)}, _PLANAR_F1, _PLANAR_SUCCESS
    ),
    DOOR.name: TaskTargets(
        {True: Asked(1.0, 0.3), False: Asked(1.2, 0.3)}, _PLANAR_F1, _PLANAR_SUCCESS
    ),
    FRANKA.name: TaskTargets(
        {True: Asked(1.0, 0.5), False: Asked(1.5, 0.5)},
        {True: Asked(0.95, 0.99), False: Asked(0.95, 0.99)},
        {True: Asked(95.0, 99.0), False: Asked(90.0, 99.0)},
        contact_speed=Asked(0.1, 0.3),
        training_s=Asked(900.0, 300.0),
        tick_ms=Asked(10.0, 2.0),
        as_it_passes=True,
    ),
}


def asked_error_cm(task: StudyTask, condition: TestCondition) -> Asked | None:
    """Of the N-step error; None for scenes that nothing is asked of."""
    if condition not in (task.as_trained, task.hardest):
        return None
    return TARGETS[task.name].error_cm[condition.in_distribution]


def targets(
    results: Results, tasks: Sequence[StudyTask], seeds: tuple[int, ...]
) -> tuple[Number, ...]:
    """Every row of the table of targets; each is judged by its median over the seeds."""
    numbers = []
    for task in tasks:
        asked = TARGETS[task.name]
        for condition in (task.as_trained, task.hardest):
            inside = condition.in_distribution
            label = f"{task.name}, {condition.name}"
            where = planned(task, GIM_TEMP, condition)
            every_step = Where(Source.every_step, task.name, GIM_TEMP.name, condition.name)
            f1 = results.number(where, "edge_f1_planned")
            f1_recorded = results.number(recorded(task, GIM_TEMP, condition), "edge_f1")
            success = results.number(every_step, "success_rate", 100.0)
            numbers += [
                judged(
                    f"{label}: N-step error, planned against executed",
                    "cm",
                    results.error_cm(where, PLANNED_ERROR),
                    asked_error_cm(task, condition),
                    seeds,
                    lower_is_better=True,
                ),
                judged(f"{label}: edge F1, the same", "", f1, asked.edge_f1[inside], seeds),
                judged(
                    f"{label}: edge F1, recorded", "", f1_recorded, asked.edge_f1[inside], seeds
                ),
                judged(f"{label}: success", "%", success, asked.success_percent[inside], seeds),
            ]
            if not asked.as_it_passes:
                continue
            speed = results.number(every_step, "contact_speed_m_s")
            tick = results.number(every_step, "plan_ms_p99")
            numbers += [
                judged(f"{label}: speed at contact", "m/s", speed, asked.contact_speed, seeds),
                judged(
                    f"{label}: control tick, 99 %, both cores busy",
                    "ms",
                    tick,
                    asked.tick_ms,
                    seeds,
                    lower_is_better=True,
                ),
            ]
    return tuple(numbers)


def judged(
    name: str,
    unit: str,
    figure: Figure,
    asked: Asked | None,
    seeds: tuple[int, ...],
    lower_is_better: bool = False,
) -> Number:
    """The median over seeds, with their range, beside what is asked of it."""
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
