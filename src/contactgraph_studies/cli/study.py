"""A study's cells made, and the files that show what they say."""

import importlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from contactgraph.cli.output import progress, provenance, write_json, write_text
from contactgraph.parallel import Executor
from contactgraph.viz.number_table import csv_numbers, markdown_numbers
from contactgraph_studies.errand import Ended
from contactgraph_studies.findings import Findings, StudyPlan
from contactgraph_studies.record import Records
from contactgraph_studies.runner import Failure, Standing, run_cells
from contactgraph_studies.study_page import StudyPage, study_page


@dataclass(frozen=True)
class Study:
    """A plan carried out in a folder."""

    plan: StudyPlan
    folder: Path
    command: str
    """That makes the study."""

    def measure(self, executor: Executor) -> list[Failure]:
        """Make the cells that are not there yet; those that failed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        records = Records(self.folder, version("contactgraph"))
        with progress("cells", len(self.plan.cells)) as steps:

            def on_step(standing: Standing) -> None:
                if standing.failure is not None:
                    _complain(standing.failure)
                steps.advance(standing.done, f"{_left(standing.seconds_left)}{standing.last.kind}")

            failures = run_cells(self.plan.cells, records, executor, _begin, on_step)
        for failure in failures:
            if failure.reason.startswith("not begun"):
                _complain(failure)
        return failures

    def write(self, failures: Sequence[Failure], cores: int) -> None:
        """Claims, tables, figures and the page, from what is there; so many cores made it."""
        found = self.plan.findings(self.folder)
        lost = [(failure.cell.command, failure.reason) for failure in failures]
        origin = self._origin(found, lost, cores)
        write_json(self.folder / "claims.json", {"claims": [one.to_json() for one in found.claims]})
        write_json(self.folder / "results.json", {**origin, "cells": found.readings})
        write_text(self.folder / "table.md", found.table_markdown)
        write_text(self.folder / "table.csv", found.table_csv)
        write_text(self.folder / "targets.md", markdown_numbers(found.targets))
        write_text(self.folder / "targets.csv", csv_numbers(found.targets))
        page = StudyPage(
            findings=found,
            failures=lost,
            commands=[self.command, *(cell.command for cell in self.plan.cells)],
            versions=provenance()["versions"],
            date=str(origin["date"]),
        )
        write_text(self.folder / "index.html", study_page(page))
        for claim in found.claims:
            print(f"{claim.number}. {_WORDS[claim.holds]}: {claim.title}")
            print(f"   {claim.sentence}")
        print(markdown_numbers(found.targets))
        print(f"the page: {self.folder / 'index.html'}")

    def _origin(self, found: Findings, lost: Sequence[tuple[str, str]], cores: int) -> dict:
        return {
            "command": self.command,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            **provenance(),
            "cores": cores,
            **found.amounts,
            "failures": [{"command": command, "reason": reason} for command, reason in lost],
        }


def _begin() -> Callable[[Any], Ended]:
    """By its name, as from outside: a worker knows every command, and so this one."""
    return importlib.import_module("contactgraph_studies.worker").begin()


_WORDS = {True: "holds", False: "does not hold", None: "not known"}


def _left(seconds: float | None) -> str:
    return "" if seconds is None else f"about {max(1, round(seconds / 60))} min left; "


def _complain(failure: Failure) -> None:
    print(f"failed: {failure.cell.command} ({failure.reason})", file=sys.stderr, flush=True)
