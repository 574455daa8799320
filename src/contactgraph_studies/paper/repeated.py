"""Some measurements of a stored study made again from nothing, and compared."""

import math
import random
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from contactgraph.data import InvalidInputError
from contactgraph.parallel import Executor
from contactgraph_studies.bootstrap import Estimate, estimate
from contactgraph_studies.job import JobRecords, Measurement, in_dependency_order
from contactgraph_studies.paper.jobs import main_number
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
        """Whether the new number lies within the stored one's interval, or both are unknown.

        One whose commands failed does not.
        """
        if not self.again.trainings:
            return False
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
                f"--check: {folder / 'results.json'} holds {len(known)} measurements of this study "
                f"and version, asked for {count}"
            )
        drawn = random.sample(known, count)
        run_reported(in_dependency_order(one.job for one in drawn), after, executor)
        return [_compared(one, before, after, known) for one in drawn]


def _compared(
    one: Measurement, before: Path, after: Path, known: Sequence[Measurement]
) -> Repeated:
    def measured(folder: Path, those: Sequence[Measurement]) -> Estimate:
        return estimate([main_number(Results.read(folder, those), one.condition)])

    stored, again = measured(before, [one]), measured(after, [one])
    if stored.low == stored.high:
        all_trainings = [each for each in known if each.condition == one.condition]
        values = measured(before, all_trainings).each
        stored = replace(stored, low=min(values), high=max(values))
    return Repeated(one, stored, again)
