"""The contract of a study: its measurements, and the claims, tables and figures made from them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from contactgraph.data import atomic_write
from contactgraph.evaluate import number_or_word
from contactgraph_studies.bootstrap import Estimate, Verdict, all_hold
from contactgraph_studies.job import Job, Measurement, in_dependency_order
from contactgraph_studies.results import Quantity, Results, SeedStatistic
from contactgraph_studies.tables import StudyTable


@dataclass(frozen=True)
class Picture:
    """A figure of the report."""

    title: str
    caption: str
    path: str
    """Of a PNG file, relative to the study's folder."""


def write_figure(folder: Path, name: str, title: str, caption: str, figure: Figure) -> Picture:
    """Write ``figures/NAME.png``."""
    picture = Picture(title, caption, f"figures/{name}.png")
    (folder / picture.path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / picture.path) as temporary:
        figure.savefig(temporary, dpi=130, format="png")
    return picture


class ClaimMetric(NamedTuple):
    """A measured number that a claim is judged by."""

    name: str
    task: str
    statistic: SeedStatistic
    interval: tuple[float, float] | None = None
    """Of 95 %, over trainings and scenes."""


@dataclass
class Claim:
    """A claim of the paper, and the evidence for or against it, collected task by task."""

    number: int
    title: str
    quote: str
    """The paper's words."""
    criterion: str
    """The condition under which it holds for these models."""
    results: Results
    tasks: Sequence[str]
    family: str = ""
    """Of the models that it is about."""
    metrics: list[ClaimMetric] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    """On each task."""
    findings: list[str] = field(default_factory=list)
    """The result on each task."""

    def measure(self, name: str, condition: Any, quantity: Quantity) -> None:
        """Record a measured number of the condition's task."""
        statistic = self.results.statistic(condition, quantity)
        self.metrics.append(ClaimMetric(name, condition.task, statistic))

    def estimated(self, name: str, task: str, found: Estimate) -> Estimate:
        """Record a number with its interval; returns it."""
        statistic = SeedStatistic(found.each, found.command, found.unit)
        self.metrics.append(ClaimMetric(name, task, statistic, (found.low, found.high)))
        return found

    @property
    def verdict(self) -> Verdict:
        """It holds if it does on every task, and does not if it does not on any."""
        return all_hold(self.verdicts)

    @property
    def holds(self) -> bool | None:
        """None: cannot be told."""
        return {Verdict.HOLDS: True, Verdict.FAILS: False}.get(self.verdict)

    @property
    def sentence(self) -> str:
        """The measured result."""
        return f"{'; '.join(self.findings)}." if self.findings else "Not measured."

    def to_json(self) -> dict[str, Any]:
        """An entry of ``claims.json``; infinity is the word ``infinite``."""
        return {
            "number": self.number,
            "title": self.title,
            "paper": self.quote,
            "holds_if": self.criterion,
            "family": self.family,
            "tasks": list(self.tasks),
            "holds": self.holds,
            "verdict": self.verdict.value,
            "verdicts": [one.value for one in self.verdicts],
            "sentence": self.sentence,
            "numbers": [
                {
                    "name": name,
                    "task": task,
                    "unit": one.unit,
                    "median": number_or_word(one.median),
                    "range_over_seeds": [number_or_word(one.low), number_or_word(one.high)],
                    "interval": None
                    if interval is None
                    else [number_or_word(end) for end in interval],
                    "values": [number_or_word(value) for value in one.values],
                    "command": one.command,
                }
                for name, task, one, interval in self.metrics
            ],
        }


@dataclass(frozen=True)
class StudyResult:
    """Everything that a study writes."""

    title: str
    summary: str
    tables: Sequence[StudyTable]
    """The first is written to ``table.csv``, all of them to ``table.md`` and ``report.md``."""
    amounts: Mapping[str, Any]
    """Seeds, episodes and so on; JSON."""
    readings: Sequence[Mapping[str, Any]]
    """Every number of every job, so that the jobs' own files need not be kept; JSON."""
    claims: Sequence[Claim] = ()
    figures: Sequence[Picture] = ()


class Study(ABC):
    """A set of measurements and their evaluation."""

    keeps_readings = False
    """Whether its numbers are kept beside its tables, so that a study can go on from them."""

    @property
    @abstractmethod
    def measurements(self) -> Sequence[Measurement]:
        """Everything that is measured."""

    @cached_property
    def jobs(self) -> list[Job]:
        """All jobs in dependency order."""
        return in_dependency_order(one.job for one in self.measurements)

    @property
    def kept_jobs(self) -> Sequence[Job]:
        """Jobs whose published numbers are shown as they are."""
        return ()

    @property
    def left_out(self) -> Sequence[str]:
        """Reasons why something cannot be measured on this machine, one line each."""
        return ()

    @abstractmethod
    def result(self, folder: Path) -> StudyResult:
        """From the outputs in the folder; figures are written to it."""
