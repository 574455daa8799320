"""The contract of a study: its measurements, and the claims, tables and figures made from them."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph.cli.tasks import Target
from contactgraph.viz import Number
from contactgraph_studies.job import Job, Measurement, in_dependency_order
from contactgraph_studies.results import Quantity, Results, SeedStatistic
from contactgraph_studies.tables import StudyTable


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    title: str
    caption: str
    image: bytes
    media_type: str
    """``svg+xml`` or ``png``."""


@dataclass(frozen=True)
class ClaimNumber:
    """A measured number that a claim is judged by."""

    name: str
    task: str
    unit: str
    statistic: SeedStatistic

    def to_json(self) -> dict[str, Any]:
        """Median and range over training seeds; infinity is the word ``infinite``."""
        statistic = self.statistic
        return {
            "name": self.name,
            "task": self.task,
            "unit": self.unit,
            "median": _json(statistic.median),
            "range_over_seeds": [_json(statistic.low), _json(statistic.high)],
            "values": [_json(value) for value in statistic.values],
            "command": statistic.command,
        }


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and whether it holds for these models."""

    number: int
    title: str
    quote: str
    """The paper's words."""
    criterion: str
    """The condition under which it holds."""
    tasks: Sequence[str]
    numbers: Sequence[ClaimNumber]
    holds: bool | None
    """None: not enough was measured."""
    sentence: str
    """The measured result."""

    def to_json(self) -> dict[str, Any]:
        """An entry of ``claims.json``."""
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


@dataclass
class Evidence:
    """The numbers and partial verdicts of one claim, collected task by task."""

    results: Results
    tasks: Sequence[str]
    numbers: list[ClaimNumber] = field(default_factory=list)
    verdicts: list[bool | None] = field(default_factory=list)
    """None: not known."""
    sentences: list[str] = field(default_factory=list)

    def add(self, name: str, task: str, unit: str, statistic: SeedStatistic) -> SeedStatistic:
        """Record a number; returns it."""
        self.numbers.append(ClaimNumber(name, task, unit, statistic))
        return statistic

    def measure(
        self, name: str, task: str, unit: str, condition: Any, quantity: Quantity
    ) -> SeedStatistic:
        """Record a measured number; returns it."""
        return self.add(name, task, unit, self.results.statistic(condition, quantity))

    def judge(self, holds: bool, *needed: SeedStatistic) -> bool:
        """Add a verdict; returns whether all ``needed`` numbers are known."""
        known = all(one.known for one in needed)
        self.verdicts.append(holds if known else None)
        return known

    @property
    def holds(self) -> bool | None:
        """True if all verdicts are; False if any is; else None."""
        if False in self.verdicts:
            return False
        return None if not self.verdicts or None in self.verdicts else True

    def claim(
        self, number: int, title: str, quote: str, criterion: str, sentence: str = ""
    ) -> Claim:
        """The claim with this evidence; the sentence is by default that of all tasks."""
        joint = f"{'; '.join(self.sentences)}." if self.sentences else "Not measured."
        sentence = sentence or joint
        holds = self.holds
        return Claim(number, title, quote, criterion, self.tasks, self.numbers, holds, sentence)


@dataclass(frozen=True)
class StudyResult:
    """Everything that a study writes."""

    title: str
    summary: str
    targets_heading: str
    targets: Sequence[Number]
    tables: Sequence[StudyTable]
    """The first is written to ``table.csv``, all of them to ``table.md`` and the page."""
    amounts: Mapping[str, Any]
    """Seeds, episodes and so on; JSON."""
    readings: Sequence[Mapping[str, Any]]
    """Every number of every job, so that the jobs' own files need not be kept; JSON."""
    claims: Sequence[Claim] = ()
    figures: Sequence[Picture] = ()
    scenes: Sequence[Picture] = ()


class Study(ABC):
    """A set of measurements and their evaluation."""

    @property
    @abstractmethod
    def measurements(self) -> Sequence[Measurement]:
        """Everything that is measured."""

    @cached_property
    def jobs(self) -> list[Job]:
        """All jobs in dependency order."""
        return in_dependency_order(one.job for one in self.measurements)

    @abstractmethod
    def result(self, folder: Path) -> StudyResult:
        """From the outputs in the folder; figures are written to it."""


def judged(
    name: str,
    unit: str,
    statistic: SeedStatistic,
    target: Target | None,
    seeds: Sequence[int],
    lower: bool = False,
) -> Number:
    """The median over seeds with its range, beside the target; ``lower``: lower is better."""
    return Number(
        name=name,
        value=statistic.median if statistic.known else None,
        unit=unit,
        interval=(statistic.low, statistic.high) if len(statistic.values) > 1 else None,
        at_least=None if target is None else target.at_least,
        aim=None if target is None else target.aim,
        lower_is_better=lower,
        command=statistic.command,
        seed=tuple(seeds),
    )


def _json(value: float) -> float | str | None:
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else "infinite"
