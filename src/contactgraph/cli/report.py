"""``contactgraph report``: one page that shows what a run has learned."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Report:
    """Test a model on fresh scenes, and write a page that shows what it learned and how well."""

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder, a model file, or a model that ships with the package (pickup)."""
    task: str = "pickup"
    """The task to test it on: pickup, multi-pickup, door or franka."""
    out: Path | None = None
    """The page to write; report/index.html in the run folder, or here, if not given."""
    test_runs: int = 20
    """Recorded runs a test condition."""
    episodes: int = 20
    """Closed-loop episodes a test condition."""
    seed: int = 1000
    """Seed of the test scenes."""

    def run(self) -> None:
        """Test, and write the page."""
        from contactgraph.cli.conditions import Conditions
        from contactgraph.cli.options import choice
        from contactgraph.cli.output import check_writable
        from contactgraph.cli.report_files import measured, write_report_files
        from contactgraph.data import InvalidInputError
        from contactgraph_studies.declared import EVERY_TASK

        if self.test_runs < 1:
            raise InvalidInputError(f"--test-runs must be at least 1, found {self.test_runs}")
        folder = Path(self.model) if Path(self.model).is_dir() else Path()
        page = self.out or folder / "report" / "index.html"
        if page.parent.exists():
            check_writable(page)
        task = choice("task", self.task, {task.name: task for task in EVERY_TASK})
        conditions = Conditions(task, self.test_runs, self.episodes, self.seed)
        result = measured(self.model, conditions, page.parent / "cells")
        command = f"contactgraph report {self.model} --task {task.name} --seed {self.seed}"
        write_report_files(page, result, self.model, command)
