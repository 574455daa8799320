"""Measured numbers of a study, as statistics over seeds."""

import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.evaluate import wilson_interval
from contactgraph.viz.metric_table import short, with_unit
from contactgraph_studies.bootstrap import Sample, mean
from contactgraph_studies.job import Measurement

Summary = Callable[[np.ndarray], np.ndarray]
"""See `Sample.summary`."""
Values = Mapping[str, Any]
"""The JSON object that a command has written."""


@dataclass(frozen=True)
class Quantity:
    """A number in the output of a command, or made of several."""

    key: str
    unit: str = ""
    """Of the number as displayed."""
    scale: float = 1.0
    null: float = math.nan
    """Value that a JSON null stands for: NaN (not known) or infinity (a diverged prediction)."""
    derived: Callable[[Values], float] | None = None
    """Reads the number of an output that has the key; NaN if it is not known."""

    def read(self, values: Values) -> float:
        """The number in the unit of display."""
        if self.derived is not None:
            return self.derived(values)
        return self.number(values[self.key])

    def number(self, value: float | str | None) -> float:
        """Of a JSON value; the word ``infinite`` is infinity."""
        if value == "infinite":
            return math.inf
        return self.null if value is None else self.scale * float(value)


def moving_error(key: str, of_all: Quantity) -> Quantity:
    """An error of moving bodies; null is infinite only if the error ``of_all`` bodies is."""
    return Quantity(key, "cm", derived=partial(_moving_cm, key=key, of_all=of_all))


def _moving_cm(values: Values, key: str, of_all: Quantity) -> float:
    if values[key] is None:
        return math.inf if math.isinf(of_all.read(values)) else math.nan
    return 100.0 * values[key]


SUCCESS_PERCENT = Quantity("success_rate", "%", 100.0)
CONTACT_SPEED = Quantity("contact_speed_m_s", "m/s")
PLANNED_F1 = Quantity("edge_f1_planned")
PLAN_MS = Quantity("plan_ms_p50", "ms")
SLOWEST_MS = Quantity("plan_ms_p99", "ms")


@dataclass(frozen=True)
class Reading:
    """The output of one job."""

    seed: int
    values: Values
    command: str
    fingerprint: str = ""
    """Of the job; see `Job.fingerprint`."""


@dataclass(frozen=True)
class SeedStatistic:
    """One number for each seed; none where the jobs failed or the number is not known."""

    values: tuple[float, ...] = ()
    """Infinite where a prediction diverged."""
    command: str = ""
    """Command of the first seed."""
    unit: str = ""

    @property
    def known(self) -> bool:
        """Whether there is any value."""
        return bool(self.values)

    @property
    def median(self) -> float:
        """NaN without any value, as `low` and `high`."""
        return statistics.median(self.values) if self.values else math.nan

    @property
    def low(self) -> float:
        """The lowest value of any seed."""
        return min(self.values, default=math.nan)

    @property
    def high(self) -> float:
        """The highest value of any seed."""
        return max(self.values, default=math.nan)

    def __str__(self) -> str:
        """The median with its unit."""
        return with_unit(self.median, self.unit)


@dataclass(frozen=True)
class Success:
    """Successful episodes of every seed of a condition.

    Seeds with scenes of their own add up. Seeds that are tested in the same scenes, such as several
    trainings, are no further trials: they stand side by side, and rate and interval are those of
    the median one, with as many trials as there are scenes.
    """

    successes: tuple[int, ...]
    episodes: tuple[int, ...]
    scene_seeds: tuple[int | None, ...]
    """Of the episodes of each seed; None: not recorded, which counts as the same scenes."""

    @property
    def shares_scenes(self) -> bool:
        """Whether several seeds are tested in the same scenes."""
        return len(set(self.scene_seeds)) < len(self.scene_seeds)

    @property
    def trials(self) -> tuple[int, int]:
        """Successes and episodes behind the rate and its interval."""
        if not self.shares_scenes:
            return sum(self.successes), sum(self.episodes)
        counts = sorted(zip(self.successes, self.episodes, strict=True), key=_share)
        return counts[(len(counts) - 1) // 2]

    @property
    def rate(self) -> float:
        """Successes over episodes."""
        return _share(self.trials)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the rate."""
        return wilson_interval(*self.trials)

    @property
    def each_percent(self) -> tuple[float, ...]:
        """%, of each seed."""
        counts = zip(self.successes, self.episodes, strict=True)
        return tuple(100.0 * _share(each) for each in counts)

    def __str__(self) -> str:
        """Per cent, with the interval."""
        low, high = (short(100.0 * end) for end in self.interval)
        if self.shares_scenes:
            each = ", ".join(short(percent) for percent in self.each_percent)
            return f"{each} % of the same {self.trials[1]} (median: {low} to {high})"
        return f"{short(100.0 * self.rate)} % of {self.trials[1]} ({low} to {high})"


def _share(counts: tuple[int, int]) -> float:
    return counts[0] / counts[1]


class Results:
    """The readings of a study by condition."""

    def __init__(self, readings: Mapping[Any, list[Reading]]) -> None:
        self._readings = readings

    @classmethod
    def read(cls, folder: Path, measurements: Sequence[Measurement]) -> "Results":
        """The outputs that exist in the folder."""
        readings: dict[Any, list[Reading]] = {}
        for one in measurements:
            of_condition = readings.setdefault(one.condition, [])
            path = folder / one.job.output
            if path.is_file():
                values, job = json.loads(path.read_text()), one.job
                of_condition.append(Reading(one.seed, values, job.command, job.fingerprint))
        return cls(readings)

    def readings(self, condition: Any) -> list[Reading]:
        """One for each seed, in order of seeds."""
        return self._readings.get(condition, [])

    def statistic(self, condition: Any, quantity: Quantity) -> SeedStatistic:
        """Of the readings that have the quantity's key."""
        read = (quantity.read(one.values) for one in self._with(condition, quantity))
        values = tuple(value for value in read if not math.isnan(value))
        return SeedStatistic(values, self.command(condition, quantity), quantity.unit)

    def sample(self, condition: Any, quantity: Quantity) -> Sample:
        """A number of each training, which all scenes tell together."""
        values = {
            one.seed: np.array([quantity.read(one.values)])
            for one in self._with(condition, quantity)
        }
        return Sample(values, None, mean, quantity.unit, self.command(condition, quantity))

    def scene_sample(self, condition: Any, quantity: Quantity, summary: Summary) -> Sample:
        """A number of each training, from the list that a quantity's key names; null: unknown."""
        readings = self._with(condition, quantity)
        values = {
            one.seed: np.array([quantity.number(each) for each in one.values[quantity.key] or []])
            for one in readings
        }
        values = {seed: each for seed, each in values.items() if len(each)}
        scenes = condition.task, condition.scenes, quantity.key
        command = self.command(condition, quantity)
        return Sample(values, scenes, summary, quantity.unit, command)

    def command(self, condition: Any, quantity: Quantity) -> str:
        """The first command that wrote the quantity's key; "" without any."""
        return next((one.command for one in self._with(condition, quantity)), "")

    def _with(self, condition: Any, quantity: Quantity) -> list[Reading]:
        return [one for one in self.readings(condition) if quantity.key in one.values]

    def success(self, condition: Any) -> Success | None:
        """Of closed-loop readings; None without any."""
        readings = self.readings(condition)
        if not readings:
            return None
        episodes = tuple(int(one.values["episodes"]) for one in readings)
        rates = [one.values["success_rate"] for one in readings]
        successes = tuple(round(r * count) for r, count in zip(rates, episodes, strict=True))
        return Success(successes, episodes, tuple(one.values.get("seed") for one in readings))

    def to_json(self, seed_key: str = "seed", omit: Sequence[str] = ()) -> list[dict[str, Any]]:
        """Labels, seed, command and values of every reading, for ``results.json``.

        Keys that contain one of ``omit`` are left out.
        """
        return [
            {
                **asdict(condition),
                seed_key: one.seed,
                "command": one.command,
                "fingerprint": one.fingerprint,
                "values": {
                    key: value
                    for key, value in one.values.items()
                    if not any(part in key for part in omit)
                },
            }
            for condition, readings in self._readings.items()
            for one in readings
        ]


def with_range(statistic: SeedStatistic) -> str:
    """The median, and the range of several seeds."""
    median = short(statistic.median)
    if len(statistic.values) < 2:
        return median
    return f"{median} ({short(statistic.low)} to {short(statistic.high)})"


def smallest(medians: Mapping[str, float]) -> frozenset[str]:
    """The names of the smallest finite number, as displayed."""
    shown = {name: short(value) for name, value in medians.items() if math.isfinite(value)}
    least = min(shown.values(), key=float, default="")
    return frozenset(name for name, text in shown.items() if text == least)
