"""The study of contact without a sensor: beliefs corrected by observed motion."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph_studies.job import Job, Measurement, Variant
from contactgraph_studies.paper.config import DOOR, FRANKA, MULTI_PICKUP, PICKUP
from contactgraph_studies.results import (
    PLAN_MS,
    PLANNED_F1,
    Quantity,
    Results,
    SeedStatistic,
    Values,
)
from contactgraph_studies.study import Study, StudyResult
from contactgraph_studies.tables import StudyTable, counts, known_text, number_text


@dataclass(frozen=True)
class SensingTask:
    """A task, controlled with the shipped model of the same name."""

    name: str
    conditions: tuple[Variant, ...]
    replan_every: int
    """Half a second, so that plans can be compared with their execution; 1 step if the task cannot
    be done that way."""


@dataclass(frozen=True)
class SensingAmounts:
    """Numbers of seeds and episodes."""

    seeds: tuple[int, ...]
    """Of scenes, above `SCENE_SEED`."""
    episodes: int
    """For each seed, condition and sensor."""


SCENE_SEED = 1200
"""No model, no other study and no tuning uses these scenes."""

MEASURED = Variant("measured", "contacts measured", ("--ignore-motion",))
UNMEASURED = Variant("unmeasured", "nothing", ("--unmeasured", "--ignore-motion"))
INFERRED = Variant("inferred", "motion", ("--unmeasured", "--infer-contacts"))
MISSING = Variant("missing", "a sensor with 30 % misses", ("--misses", "0.3", "--ignore-motion"))
BOTH = Variant("both", "that sensor and motion", ("--misses", "0.3", "--infer-contacts"))
SENSORS = (MEASURED, UNMEASURED, INFERRED, MISSING, BOTH)
"""Contact information that a controller receives."""

_CAMERA = ("--position-noise", "0.001", "--velocity-noise", "0.02")
_WIDER = ("--radius", "0.042")
AS_TRAINED = Variant("as-trained", "as trained")
CAMERA = Variant("camera", "seen by a camera (1 mm, 2 cm/s)", _CAMERA)
WIDER = Variant("wider", "bodies 5 % wider than the model knows", _WIDER)
BOTH_OFF = Variant("wider-camera", "wider, and seen by a camera", (*_WIDER, *_CAMERA))
"""A model with exact radii predicts contact without any sensor. A sensor can help if the radii are
wrong, and 2 mm is a realistic error."""

PICKUP_SENSING = SensingTask(PICKUP.name, (WIDER, AS_TRAINED, CAMERA, BOTH_OFF), 10)
SENSING_TASKS = (
    PICKUP_SENSING,
    SensingTask(MULTI_PICKUP.name, (CAMERA,), 10),
    SensingTask(DOOR.name, (CAMERA,), 10),
    SensingTask(FRANKA.name, (CAMERA,), 1),
)

FULL_SENSING = SensingAmounts((0, 1, 2), 20)
QUICK_SENSING = SensingAmounts((0,), 3)

_GAINS = {
    "n_step_rmse_planned_m": "planned error",
    "edge_f1_found": "edge F1",
    "success_rate": "success",
}
_NO_GAIN = 0.02
"""Relative gain by measured contacts below which there is nothing to recover."""
_F1 = Quantity("edge_f1_found")
_ERROR = Quantity("n_step_rmse_planned_m", "cm", 100.0)


@dataclass(frozen=True)
class SensorCondition:
    """The labels of a number in ``results.json``."""

    task: str
    condition: str
    contacts_known_by: str


@dataclass(frozen=True)
class SensingStudy(Study):
    """Control of some tasks with every sensor."""

    amounts: SensingAmounts
    tasks: Sequence[SensingTask] = SENSING_TASKS

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Everything that is measured."""
        return [
            Measurement(
                SensorCondition(task.name, condition.name, sensor.name),
                seed,
                _control_job(task, condition, sensor, seed, self.amounts),
            )
            for task in self.tasks
            for condition in task.conditions
            for sensor in (SENSORS if condition is WIDER else SENSORS[:3])
            for seed in self.amounts.seeds
        ]

    def result(self, folder: Path) -> StudyResult:
        """Tables; the paper makes no claim."""
        results = Results.read(folder, self.measurements)
        seeds, episodes = self.amounts.seeds, self.amounts.episodes
        conditions = list(dict.fromkeys(one.condition for one in self.measurements))
        return StudyResult(
            title="Contact without a sensor",
            summary="Contact beliefs, corrected by how well each hypothesis explains the observed "
            "motion, compared with beliefs that measured contacts correct and with beliefs "
            f"without correction. The shipped models; {len(seeds)} seed(s) of scenes, {episodes} "
            "episodes each.",
            tables=[sensing_table(results, conditions), recovered_table(results)],
            amounts={
                "episodes": episodes,
                "scene_seeds": [SCENE_SEED + seed for seed in seeds],
            },
            readings=results.to_json(),
        )


def _control_job(
    task: SensingTask, condition: Variant, sensor: Variant, seed: int, amounts: SensingAmounts
) -> Job:
    output = f"cells/{task.name}/{condition.slug}/{sensor.slug}-{seed}.json"
    replan = () if task.replan_every == 1 else ("--replan-every", str(task.replan_every))
    arguments = (
        *("control", task.name, task.name),
        *("--episodes", str(amounts.episodes), "--seed", str(SCENE_SEED + seed)),
        *(*replan, *condition.options, *sensor.options),
        *("--json", output),
    )
    group = f"control {task.name} {'inferred' if '--infer-contacts' in sensor.options else ''}"
    return Job(output, arguments, group)


def sensing_table(results: Results, conditions: Sequence[SensorCondition]) -> StudyTable:
    """Every sensor under every condition."""

    numbers = {
        "edge F1": _F1,
        "onset delay, ms: median": _delay_ms("onset_delay_ms_p50"),
        "95 %": ONSET_DELAY_P95,
        "planned error, cm": _ERROR,
        "edge F1, planned": PLANNED_F1,
        "control tick, ms": PLAN_MS,
    }
    labels = ("Task", "Condition", "Contacts known by")

    def row(condition: SensorCondition) -> dict[str, Any]:
        success = results.success(condition)
        return {
            **dict(zip(labels, astuple(condition), strict=True)),
            "_success": success or "not known",
            **counts(success),
            **{name: results.statistic(condition, one) for name, one in numbers.items()},
            "command": results.statistic(condition, _F1).command,
        }

    return StudyTable(
        slug="table",
        title="Every sensor",
        caption="Median over seeds of scenes, with their range; success of all episodes together, "
        "each in a scene of its own. Edge F1: beliefs about the last step, corrected by all "
        "observations, against contacts. Delay: from the first observation at which a contact "
        "holds to the first at which it is believed. Planned: over 0.5 s, planned against executed "
        "positions. An infinite delay is a contact that was never detected.",
        headings={
            **{name: name for name in labels},
            "_success": "success (95 %)",
            **{name: name for name in numbers},
        },
        texts=dict.fromkeys(numbers, known_text),
        rows=[row(condition) for condition in conditions],
        separator=" ",
    )


def recovered_table(results: Results) -> StudyTable:
    """The shares of `share_recovered` on pickup."""
    return StudyTable(
        slug="recovered",
        title="Recovered by motion",
        caption="Share of what measured contacts gain over no correction that motion alone gains, "
        "%, of all seeds together. A dash: measured contacts gain nothing, or a number is missing.",
        headings={"condition": "Condition", **{name: name for name in _GAINS.values()}},
        texts=dict.fromkeys(_GAINS.values(), number_text),
        rows=[
            {
                "condition": condition.name,
                **{
                    name: share_recovered(results, PICKUP_SENSING, condition, key)
                    for key, name in _GAINS.items()
                },
            }
            for condition in PICKUP_SENSING.conditions
        ],
    )


def _delay_ms(key: str) -> Quantity:
    """A delay of contact onsets; infinite if a contact was never detected."""

    def delay(values: Values) -> float:
        count = values[f"{key.split('_', maxsplit=1)[0]}s"]
        return math.nan if not count else math.inf if values[key] is None else float(values[key])

    return Quantity(key, "ms", derived=delay)


ONSET_DELAY_P95 = _delay_ms("onset_delay_ms_p95")


def share_recovered(
    results: Results, task: SensingTask, condition: Variant, key: str
) -> SeedStatistic:
    """[%] Gain by motion over the gain by measured contacts, of all seeds together.

    Without a value if measured contacts gain nothing or a number is missing.
    """
    means = []
    for sensor in (MEASURED, UNMEASURED, INFERRED):
        where = SensorCondition(task.name, condition.name, sensor.name)
        statistic = results.statistic(where, Quantity(key))
        if not statistic.known or len(statistic.values) < len(results.readings(where)):
            return SeedStatistic(unit="%")
        means.append(sum(statistic.values) / len(statistic.values))
    best, worst, reached = means
    if abs(best - worst) < _NO_GAIN * abs(worst):
        return SeedStatistic(unit="%")
    return SeedStatistic((100.0 * (reached - worst) / (best - worst),), statistic.command, "%")
