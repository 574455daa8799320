"""A study's cells made, and the files that show what they say."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from contactgraph.commands.cores import usable_cores
from contactgraph.commands.output import progress, say, write_json, write_text
from contactgraph.commands.provenance import provenance
from contactgraph.reproduce.cell import Cell, in_order
from contactgraph.reproduce.claim import Claim
from contactgraph.reproduce.claims import claims
from contactgraph.reproduce.declared import Amounts, StudyTask
from contactgraph.reproduce.number_table import csv_numbers, markdown_numbers
from contactgraph.reproduce.pictures import figure_pictures, scene_pictures
from contactgraph.reproduce.plan_cells import Measurement, measurements
from contactgraph.reproduce.record import Records
from contactgraph.reproduce.results import Results
from contactgraph.reproduce.runner import Failure, Standing, run_cells
from contactgraph.reproduce.study_page import StudyPage, study_page
from contactgraph.reproduce.study_table import csv_rows, markdown_rows, rows
from contactgraph.reproduce.targets import targets


@dataclass(frozen=True)
class Study:
    """Some tasks, so much of everything, in a folder."""

    tasks: Sequence[StudyTask]
    amounts: Amounts
    folder: Path
    command: str
    """That makes the study."""

    @cached_property
    def wanted(self) -> list[Measurement]:
        """All that is measured."""
        return measurements(self.tasks, self.amounts)

    @cached_property
    def cells(self) -> list[Cell]:
        """All that is made for it, in order of need."""
        return in_order(one.cell for one in self.wanted)

    def measure(self) -> list[Failure]:
        """Make the cells that are not there yet, one a core at a time; those that failed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        records = Records(self.folder, version("contactgraph"))
        # One core a cell: trainings of this size gain nothing from a second one.
        workers = [
            [sys.executable, "-m", "contactgraph.worker", str(core)] for core in usable_cores()
        ]
        with progress("cells", len(self.cells)) as steps:

            def on_step(standing: Standing) -> None:
                if standing.failure is not None:
                    _complain(standing.failure)
                steps.advance(standing.done, f"{_left(standing.seconds_left)}{standing.last.kind}")

            failures = run_cells(self.cells, records, workers, on_step)
        for failure in failures:
            if failure.reason.startswith("not begun"):
                _complain(failure)
        return failures

    def write(self, failures: Sequence[Failure]) -> None:
        """Claims, tables, figures and the page, from what is there."""
        results = Results.read(self.folder, self.wanted)
        found = claims(results, self.tasks, self.amounts)
        asked = targets(results, self.tasks, self.amounts.seeds)
        table = rows(results, self.tasks, self.amounts)
        lost = [(failure.cell.command, failure.reason) for failure in failures]
        origin = self._origin(lost)
        write_json(self.folder / "claims.json", {"claims": [one.to_json() for one in found]})
        write_json(self.folder / "results.json", {**origin, "cells": self._readings(results)})
        write_text(self.folder / "table.md", markdown_rows(table))
        write_text(self.folder / "table.csv", csv_rows(table))
        write_text(self.folder / "targets.md", markdown_numbers(asked))
        write_text(self.folder / "targets.csv", csv_numbers(asked))
        figures = figure_pictures(self.folder, results, table, self.tasks, self.amounts)
        scenes, insights = scene_pictures(self.folder, self.tasks, self.wanted)
        page = StudyPage(
            title="A contact graph, claim by claim",
            summary=f"What the paper says, measured anew: {_told(found)} "
            f"{len(self.amounts.seeds)} training seed(s), {self.amounts.episodes} closed-loop "
            "episodes a cell, in scenes that no training has seen.",
            claims=found,
            targets=asked,
            table=table,
            figures=[*figures, *insights],
            scenes=scenes,
            failures=lost,
            commands=[self.command, *(cell.command for cell in self.cells)],
            versions=provenance()["versions"],
            date=str(origin["date"]),
        )
        write_text(self.folder / "index.html", study_page(page))
        for claim in found:
            say(f"{claim.number}. {_WORDS[claim.holds]}: {claim.title}")
            say(f"   {claim.sentence}")
        say(markdown_numbers(asked))
        say(f"the page: {self.folder / 'index.html'}")

    def _origin(self, lost: Sequence[tuple[str, str]]) -> dict:
        return {
            "command": self.command,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **provenance(),
            "cores": len(usable_cores()),
            "training_seeds": list(self.amounts.seeds),
            "test_runs": self.amounts.test_runs,
            "episodes": self.amounts.episodes,
            "success_episodes": self.amounts.success_episodes,
            "failures": [{"command": command, "reason": reason} for command, reason in lost],
        }

    def _readings(self, results: Results) -> list[dict]:
        """Every number of every cell, so that the cells' own folders need not be kept."""
        return [
            {
                "source": where.source.name,
                "task": where.task,
                "model": where.model,
                "scenes": where.condition,
                "sensor": where.fault or None,
                "training_runs": where.runs or None,
                "training_seed": reading.seed,
                "command": reading.command,
                "values": reading.values,
            }
            for where in dict.fromkeys(one.where for one in self.wanted)
            for reading in results.readings(where)
        ]


_WORDS = {True: "holds", False: "does not hold", None: "not known"}


def _told(found: Sequence[Claim]) -> str:
    held = sum(claim.holds is True for claim in found)
    return f"{held} of {len(found)} claims hold for our models."


def _left(seconds: float | None) -> str:
    return "" if seconds is None else f"about {max(1, round(seconds / 60))} min left; "


def _complain(failure: Failure) -> None:
    print(f"failed: {failure.cell.command} ({failure.reason})", file=sys.stderr, flush=True)
