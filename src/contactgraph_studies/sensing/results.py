"""The cells of the study of contact without a sensor, and its numbers looked up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph_studies.cell import Cell
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.results import Figure, Results
from contactgraph_studies.sensing.declared import (
    INFERRED,
    MEASURED,
    SCENE_SEED,
    UNMEASURED,
    Condition,
    SensingAmounts,
    SensingTask,
    Sensor,
    sensors_of,
)

_WORTHLESS = 0.02
"""Of the number without a sensor: where contacts measured gain less, nothing is to recover."""


@dataclass(frozen=True)
class Sensed:
    """What a number is of."""

    task: str
    condition: str
    sensor: str


def sensing_measurements(
    tasks: Sequence[SensingTask], amounts: SensingAmounts
) -> list[Measurement[Sensed]]:
    """All of the study."""
    return [
        Measurement(
            Sensed(task.name, condition.name, sensor.name),
            seed,
            control_cell(task, condition, sensor, seed, amounts),
        )
        for task in tasks
        for condition in task.conditions
        for sensor in sensors_of(condition)
        for seed in amounts.seeds
    ]


def control_cell(
    task: SensingTask, condition: Condition, sensor: Sensor, seed: int, amounts: SensingAmounts
) -> Cell:
    """Closed-loop episodes."""
    output = f"cells/{task.name}/{condition.slug}/{sensor.slug}-{seed}.json"
    counts = ("--episodes", str(amounts.episodes), "--seed", str(SCENE_SEED + seed))
    every = () if task.replan_every == 1 else ("--replan-every", str(task.replan_every))
    arguments = ("control", task.name, task.name, *counts, *every, *condition.options)
    kind = f"control {task.name} {'inferred' if '--infer-contacts' in sensor.options else ''}"
    return Cell(output, (*arguments, *sensor.options, "--json", output), kind)


def delay_ms(results: Results, where: Sensed, name: str) -> Figure:
    """A delay of the episodes of every seed; infinite where a contact was never found."""

    def value(values: dict) -> float:
        count = values[f"{name.split('_', maxsplit=1)[0]}s"]
        told = values[name]
        return math.nan if not count else math.inf if told is None else float(told)

    return results.derived(where, value)


def share_recovered(results: Results, task: SensingTask, condition: Condition, key: str) -> Figure:
    """[%] Of what contacts measured gain, what motion gains, by all seeds together; none where
    there is nothing to gain."""
    sums = []
    for sensor in (MEASURED, UNMEASURED, INFERRED):
        readings = results.readings(Sensed(task.name, condition.name, sensor.name))
        values = [float(found) for one in readings if (found := one.values.get(key)) is not None]
        if not values or len(values) < len(readings):
            return Figure(())
        sums.append((sum(values) / len(values), readings[0].command))
    (best, _), (worst, _), (found, command) = sums
    if abs(best - worst) < _WORTHLESS * abs(worst):
        return Figure(())
    return Figure((100.0 * (found - worst) / (best - worst),), command)
