"""A claim of the paper beside what was measured."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from contactgraph_studies.results import Figure


@dataclass(frozen=True)
class ClaimNumber:
    """One of our numbers about a claim."""

    name: str
    task: str
    unit: str
    figure: Figure

    def to_json(self) -> Mapping[str, Any]:
        """Median and range over training seeds; what is infinite is the word."""
        return {
            "name": self.name,
            "task": self.task,
            "unit": self.unit,
            "median": _json(self.figure.median),
            "range_over_seeds": [_json(self.figure.low), _json(self.figure.high)],
            "values": [_json(value) for value in self.figure.values],
            "command": self.figure.command,
        }


@dataclass(frozen=True)
class Claim:
    """What the paper says, and whether it holds for our models."""

    number: int
    title: str
    """In our words."""
    quote: str
    """In the paper's words."""
    criterion: str
    """When we say that it holds."""
    tasks: tuple[str, ...]
    numbers: tuple[ClaimNumber, ...]
    holds: bool | None
    """None: not enough was measured to say."""
    sentence: str
    """What was found."""

    def to_json(self) -> dict[str, Any]:
        """For ``claims.json``."""
        return {
            "number": self.number,
            "title": self.title,
            "paper": self.quote,
            "holds_if": self.criterion,
            "tasks": list(self.tasks),
            "holds": self.holds,
            "sentence": self.sentence,
            "numbers": [number.to_json() for number in self.numbers],
        }


def verdict(found: list[bool | None]) -> bool | None:
    """True where all are; False where one is; None where one is unknown, or there is none."""
    if False in found:
        return False
    return None if not found or None in found else True


def _json(value: float) -> float | str | None:
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else "infinite"
