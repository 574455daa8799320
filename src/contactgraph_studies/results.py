"""What the cells of a study measured, as one number a seed."""

import json
import math
import statistics
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contactgraph_studies.measurement import Measurement


@dataclass(frozen=True)
class Reading:
    """One cell's numbers."""

    seed: int
    values: dict[str, Any]
    """JSON of the command, by its keys."""
    command: str


@dataclass(frozen=True)
class Figure:
    """One number of every seed; none where its cells could not be made."""

    values: tuple[float, ...]
    """Infinite where a prediction was not finite."""
    command: str = ""
    """Of the first seed."""

    @property
    def known(self) -> bool:
        """Whether there is any value."""
        return bool(self.values)

    @property
    def median(self) -> float:
        """Over the seeds; NaN where there are none."""
        return statistics.median(self.values) if self.values else math.nan

    @property
    def low(self) -> float:
        """The lowest of any seed."""
        return min(self.values, default=math.nan)

    @property
    def high(self) -> float:
        """The highest of any seed."""
        return max(self.values, default=math.nan)


class Results:
    """All that was measured, looked up by what it is of."""

    def __init__(self, readings: Mapping[Any, list[Reading]]) -> None:
        self._readings = readings

    @classmethod
    def read(cls, folder: Path, wanted: Sequence[Measurement]) -> "Results":
        """The outputs that are there; a cell that failed has left none."""
        readings: dict[Hashable, list[Reading]] = {}
        for one in wanted:
            path = folder / one.cell.output
            if path.is_file():
                reading = Reading(one.seed, json.loads(path.read_text()), one.cell.command)
                readings.setdefault(one.where, []).append(reading)
        return cls(readings)

    def readings(self, where: Hashable) -> list[Reading]:
        """One a seed, in order of seeds."""
        return self._readings.get(where, [])

    def error_cm(self, where: Hashable, key: str) -> Figure:
        """An error in m, as cm. Null is infinite: commands say so of predictions not finite."""
        return self._figure(where, lambda values: _scaled(values.get(key), 100.0, math.inf), key)

    def moving_error_cm(self, where: Hashable, key: str, every_key: str) -> Figure:
        """An error of moving bodies alone, cm. Null where nothing moves too: then not known.

        ``every_key`` is of all bodies, and tells the two apart.
        """
        return self.derived(
            where,
            lambda values: _scaled(
                values.get(key), 100.0, math.inf if values.get(every_key) is None else math.nan
            ),
        )

    def number(self, where: Hashable, key: str, scale: float = 1.0) -> Figure:
        """Any other number. Seeds whose number is null, which is not known, are left out."""
        return self._figure(where, lambda values: _scaled(values.get(key), scale, math.nan), key)

    def growth(self, where: Hashable, key: str) -> Figure:
        """A growth factor; null is infinite."""
        return self._figure(where, lambda values: _scaled(values.get(key), 1.0, math.inf), key)

    def derived(self, where: Hashable, value: Callable[[dict[str, Any]], float]) -> Figure:
        """A number made of several; NaN where it is not known."""
        return self._figure(where, value, None)

    def _figure(
        self, where: Hashable, value: Callable[[dict[str, Any]], float], key: str | None
    ) -> Figure:
        readings = [
            reading for reading in self.readings(where) if key is None or key in reading.values
        ]
        values = [value(reading.values) for reading in readings]
        known = tuple(one for one in values if not math.isnan(one))
        return Figure(known, readings[0].command if readings else "")


def _scaled(value: float | None, scale: float, missing: float) -> float:
    return missing if value is None else scale * value
