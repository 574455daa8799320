"""The study of all tasks beside baselines: one model for each task and seed."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Self

from matplotlib.figure import Figure

from contactgraph.cli.options import choice
from contactgraph.data import InvalidInputError
from contactgraph.viz.figures import error_figure
from contactgraph_studies.figures import write_figure
from contactgraph_studies.job import JobRecords, Measurement
from contactgraph_studies.results import Results
from contactgraph_studies.study import Study, StudyResult
from contactgraph_studies.world_row import INFERRED, MEASURED, WorldRow
from contactgraph_studies.world_table import world_table
from contactgraph_studies.worlds import WORLDS, World, WorldAmounts, world_measurements


@dataclass(frozen=True)
class StudyOfWorlds(Study):
    """Every world is shown; those of ``only`` are measured."""

    amounts: WorldAmounts
    worlds: Sequence[World] = WORLDS
    only: tuple[str, ...] = ()
    """Slugs; empty: all."""

    def restricted(self, names: str) -> Self:
        """To a comma-separated list of worlds.

        Raises `InvalidInputError` for an unknown name, and if every named world lacks a package.
        """
        known = {world.slug: world for world in self.worlds}
        chosen = [choice("--only", name.strip(), known) for name in names.split(",")]
        missing = [world.missing for world in chosen if world.missing is not None]
        if len(missing) == len(chosen):
            raise InvalidInputError(f"--only: {missing[0]}")
        return replace(self, only=tuple(world.slug for world in chosen))

    @abstractmethod
    def measured(self, worlds: Sequence[World]) -> list[Measurement]:
        """Everything that is measured of these worlds, one after the other."""

    @cached_property
    def measurements(self) -> list[Measurement]:
        """Of the chosen worlds whose packages are installed."""
        chosen = [world for world in self.worlds if not self.only or world.slug in self.only]
        return self.measured([one for one in chosen if one.missing is None])

    @property
    def left_out(self) -> Sequence[str]:
        """The worlds that lack a package, each with the extra that installs it."""
        return [world.missing for world in self.worlds if world.missing is not None]

    def finished(self, folder: Path) -> tuple[Results, JobRecords]:
        """All numbers of jobs that were done by the same command and version.

        Others are not shown, because with ``only`` they are not repeated.
        """
        records = JobRecords(folder, version("contactgraph"))
        every = self.measured([world for world in self.worlds if world.missing is None])
        done = [one for one in every if records.seconds(one.job) is not None]
        return Results.read(folder, done), records


class WorldStudy(StudyOfWorlds):
    """Every task beside all baselines."""

    def measured(self, worlds: Sequence[World]) -> list[Measurement]:
        """Predictions and control by each training, and control by scripted policies."""
        return world_measurements(worlds, self.amounts)

    def result(self, folder: Path) -> StudyResult:
        """Table and figure."""
        amounts, rows = self.amounts, self.rows(folder)
        summary = (
            "Every task, predicted and controlled with models of one method and one set of "
            f"defaults, beside baselines: {len(amounts.seeds)} training seed(s), "
            f"{amounts.training_runs} trajectories each, {amounts.test_runs} to test on. "
            f"{amounts.fast_episodes} controlled scenes of pickup, multi-pickup and door, "
            f"{amounts.episodes} of the others."
        )
        warning = " Quick: trainings are cut short, so these numbers are worth nothing."
        figure = world_figure(rows)
        return StudyResult(
            title="Every task beside its baselines",
            summary=summary + (warning if amounts.quick else ""),
            tables=[world_table(rows)],
            figures=[write_figure(folder, "errors", "Errors of every task", _CAPTION, figure)],
            amounts={
                "training_seeds": list(amounts.seeds),
                "training_runs": amounts.training_runs,
                "test_runs": amounts.test_runs,
                "episodes": amounts.episodes,
                "fast_episodes": amounts.fast_episodes,
                "quick": amounts.quick,
                "training_s": {row.name: list(row.training_s.values) for row in rows},
            },
            readings=rows[0].results.to_json(),
        )

    def rows(self, folder: Path) -> list[WorldRow]:
        """All rows of the table."""
        results, records = self.finished(folder)
        return [
            WorldRow(world, scenes, self.amounts, results, records)
            for world in self.worlds
            for scenes in world.scenes
        ]


_CAPTION = (
    "Error over moving bodies, 0.5 s ahead, cm. A dot of ours for each training; baselines by "
    "their median. What is not known, or not finite, is not drawn."
)
_COLUMNS = {MEASURED: "n_step", INFERRED: "n_step_inferred"}


def world_figure(rows: Sequence[WorldRow]) -> Figure:
    """Errors of every row: all trainings of ours, and the median of a baseline."""
    return error_figure(
        {
            row.name: {
                _COLUMNS.get(name, name.removesuffix("_cm")): each.values
                if name in _COLUMNS
                else [each.median]
                for name, each in row.errors.items()
            }
            for row in rows
        }
    )
