"""What GIM-Temp must reach on each task, beside what it reaches."""

from collections.abc import Sequence

from contactgraph.cli.tasks import TASKS as LIBRARY_TASKS
from contactgraph.cli.tasks import Target as Asked
from contactgraph.viz import Number
from contactgraph_franka.envs.task_entry import FRANKA as FRANKA_TASK
from contactgraph_studies.claims_error import PLANNED_ERROR, planned
from contactgraph_studies.claims_graph import recorded
from contactgraph_studies.declared import (
    FRANKA,
    GIM_TEMP,
    StudyTask,
    TestCondition,
)
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Figure, Results

TARGETS = {name: task.targets for name, task in {**LIBRARY_TASKS, FRANKA.name: FRANKA_TASK}.items()}


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
            if task is not FRANKA:
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
