"""The command ``contactgraph reproduce``: a study, from nothing to a page of verdicts."""

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.parallel import Executor
    from contactgraph_studies.runner import Failure
    from contactgraph_studies.study import Study


@dataclass(frozen=True)
class Reproduce:
    """Record, train and test every model of the paper, and judge the paper's claims.

    With cost: learn costs from demonstrations, and control in scenes without demonstrations. With
    sensing: control without a contact sensor. With rehearsal: record, train and control through an
    arm's protocol and a camera. The same command continues an interrupted study; finished jobs are
    kept.
    """

    study: Positional[Annotated[str, arg(metavar="STUDY")]] = "all"
    """The study: pickup, multi-pickup, door, all of these (all), franka (an arm), cost, sensing, or
    rehearsal."""
    quick: bool = False
    """One seed and few test scenes: half an hour on two cores for all tasks."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The folder to write; results/study for all, results/STUDY for another, if not given."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: one job per core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.cli.options import choice
        from contactgraph.data import InvalidInputError

        study = choice("study", self.study, _studies(self.quick))
        folder = self.out or Path("results") / ("study" if self.study == "all" else self.study)
        if folder.exists() and not folder.is_dir():
            raise InvalidInputError(f"--out: {folder} must be a folder, found a file")
        with self._executor() as executor:
            failures = _run(study, folder, executor)
            cores = executor.workers
        command = f"contactgraph reproduce {self.study}{' --quick' if self.quick else ''}"
        write_study(study, folder, command, failures, cores)
        if failures:
            sys.exit(1)  # the page is written, but incomplete

    def _executor(self) -> "AbstractContextManager[Executor]":
        from contactgraph.cli.options import open_executor
        from contactgraph.data import InvalidInputError
        from contactgraph.parallel import LocalExecutor

        if self.study != "rehearsal":
            return open_executor(self.cluster)
        if self.cluster != "local":
            raise InvalidInputError(
                f"--cluster: a rehearsal runs on this machine (local), found {self.cluster!r}"
            )
        # Server, camera, planner and control loop run in real time side by side, on all cores.
        return nullcontext(LocalExecutor(whole_machine=True))


def _studies(quick: bool) -> "dict[str, Study]":
    """All studies by name."""
    from contactgraph_studies.cost.config import COST_TASKS, FULL_COST, QUICK_COST
    from contactgraph_studies.cost.study import CostStudy
    from contactgraph_studies.paper.config import EVERY_TASK, FULL, QUICK, TASKS
    from contactgraph_studies.paper.study import ModelStudy
    from contactgraph_studies.sensing import (
        FULL_SENSING,
        QUICK_SENSING,
        SENSING_TASKS,
        SensingStudy,
    )
    from contactgraph_studies.simulated_robot import FULL_SIM, QUICK_SIM, SimulatedRobotStudy

    amounts = QUICK if quick else FULL
    return {
        **{task.name: ModelStudy((task,), amounts) for task in EVERY_TASK},
        "cost": CostStudy(COST_TASKS, QUICK_COST if quick else FULL_COST),
        "sensing": SensingStudy(SENSING_TASKS, QUICK_SENSING if quick else FULL_SENSING),
        "rehearsal": SimulatedRobotStudy(QUICK_SIM if quick else FULL_SIM),
        "all": ModelStudy(TASKS, amounts),
    }


def _run(study: "Study", folder: Path, executor: "Executor") -> "list[Failure]":
    """Run the jobs that are not done; the failures."""
    from contactgraph.cli.output import progress
    from contactgraph_studies.execution import create_worker
    from contactgraph_studies.job import JobRecords
    from contactgraph_studies.runner import Failure, Progress, run_jobs

    def report(failure: Failure) -> None:
        command = failure.job.command
        print(f"failed: {command} ({failure.reason})", file=sys.stderr, flush=True)

    folder.mkdir(parents=True, exist_ok=True)
    records = JobRecords(folder, version("contactgraph"))
    with progress("jobs", len(study.jobs)) as bar:

        def on_progress(now: Progress) -> None:
            if now.failure is not None:
                report(now.failure)
            left = now.seconds_left
            estimate = "" if left is None else f"about {max(1, round(left / 60))} min left; "
            bar.advance(now.done, f"{estimate}{now.last.group}")

        failures = run_jobs(study.jobs, records, executor, create_worker, on_progress)
    for failure in failures:
        if not failure.started:
            report(failure)
    return failures


def write_study(
    study: "Study", folder: Path, command: str, failures: "list[Failure]", cores: int
) -> None:
    """Write claims, tables, figures and the page from the outputs in the folder."""
    from contactgraph.cli.output import provenance, write_json, write_text
    from contactgraph.viz.number_table import csv_numbers, markdown_numbers
    from contactgraph_studies.page import VERDICTS, study_page

    result = study.result(folder)
    origin = provenance()
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    failed = [(failure.job.command, failure.reason) for failure in failures]
    write_json(folder / "claims.json", {"claims": [claim.to_json() for claim in result.claims]})
    write_json(
        folder / "results.json",
        {
            "command": command,
            "date": date,
            **origin,
            "cores": cores,
            **result.amounts,
            "failures": [{"command": line, "reason": reason} for line, reason in failed],
            "cells": result.readings,
        },
    )
    write_text(folder / "table.md", "\n".join(table.markdown() for table in result.tables))
    write_text(folder / "table.csv", result.tables[0].csv())
    write_text(folder / "targets.md", markdown_numbers(result.targets))
    write_text(folder / "targets.csv", csv_numbers(result.targets))
    commands = [command, *(job.command for job in study.jobs)]
    page = study_page(result, failed, commands, origin["versions"], date)
    write_text(folder / "index.html", page)
    for claim in result.claims:
        print(f"{claim.number}. {VERDICTS[claim.holds]}: {claim.title}")
        print(f"   {claim.sentence}")
    print(markdown_numbers(result.targets))
    print(f"the page: {folder / 'index.html'}")
