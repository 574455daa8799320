"""Some measurements of a stored study made again from nothing, and compared."""

import math
import random
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from contactgraph.data import InvalidInputError
from contactgraph.parallel import Executor
from contactgraph_studies.bootstrap import Estimate, Sample, estimate, mean, root_mean_square
from contactgraph_studies.job import JobRecords, Measurement, in_dependency_order
from contactgraph_studies.paper.jobs import (
    EDGE_ACCURACY,
    PLANNED_BY_EPISODE,
    RECORDED_BY_RUN,
    SUCCESS_BY_EPISODE,
    ModelCondition,
    Source,
)
from contactgraph_studies.paper.study import ModelStudy
from contactgraph_studies.results import Results
from contactgraph_studies.runner import run_reported


@dataclass(frozen=True)
class Repeated:
    """The number of one measurement, as stored and made again."""

    measurement: Measurement
    stored: Estimate
    """Its interval is over scenes; of a number that has none, the range of all trainings."""
    again: Estimate

    @property
    def agrees(self) -> bool:
        """Whether the new number lies within the stored one's interval, or both are unknown."""
        if math.isnan(self.stored.value) or math.isnan(self.again.value):
            return math.isnan(self.stored.value) and math.isnan(self.again.value)
        return self.stored.low <= self.again.value <= self.stored.high

    def __str__(self) -> str:
        """One line."""
        of, verdict = self.measurement.condition, "agrees" if self.agrees else "DIFFERS"
        about = [of.task, of.scenes, of.model, f"seed {self.measurement.seed}", of.source]
        about += [str(each) for each in (of.sensor, of.training_runs) if each is not None]
        return f"{', '.join(about)}: {self.stored}, again {self.again}: {verdict}"


def repeat(study: ModelStudy, folder: Path, count: int, executor: Executor) -> list[Repeated]:
    """Measure ``count`` numbers again, drawn at random from those in the folder's results.json.

    Raises:
        InvalidInputError: it holds fewer, or none of this version of the package.
    """
    with tempfile.TemporaryDirectory() as temporary:
        before, after = Path(temporary) / "before", Path(temporary) / "after"
        before.mkdir()
        if (folder / "results.json").is_file():
            shutil.copy(folder / "results.json", before)
        JobRecords(before, version("contactgraph")).restore(study.jobs)
        known = [one for one in study.measurements if (before / one.job.output).is_file()]
        if not 1 <= count <= len(known):
            raise InvalidInputError(
                f"--check: must be 1 to {len(known)}, the measurements of this study and version "
                f"in {folder / 'results.json'}, found {count}"
            )
        drawn = random.sample(known, count)
        run_reported(in_dependency_order(one.job for one in drawn), after, executor)
        return [_compared(one, before, after, known) for one in drawn]


def _compared(
    one: Measurement, before: Path, after: Path, known: Sequence[Measurement]
) -> Repeated:
    stored, again = (estimate([_number(folder, [one])]) for folder in (before, after))
    if stored.low == stored.high:
        all_trainings = [each for each in known if each.condition == one.condition]
        values = estimate([_number(before, all_trainings)]).each
        low, high = min(values, default=math.nan), max(values, default=math.nan)
        stored = Estimate(stored.value, low, high, stored.each, stored.unit, stored.command, 1)
    return Repeated(one, stored, again)


def _number(folder: Path, measurements: Sequence[Measurement]) -> Sample:
    """What a measurement is made for: an error, success, or the accuracy of edges."""
    results = Results.read(folder, measurements)
    condition: ModelCondition = measurements[0].condition
    match condition.source:
        case Source.planned:
            return results.scene_sample(condition, PLANNED_BY_EPISODE, root_mean_square)
        case Source.every_step | Source.long_plan:
            return results.scene_sample(condition, SUCCESS_BY_EPISODE, mean)
        case Source.faults:
            return results.sample(condition, EDGE_ACCURACY)
    return results.scene_sample(condition, RECORDED_BY_RUN, root_mean_square)
