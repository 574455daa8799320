"""The command ``contactgraph reproduce``: a study, from nothing to tables and verdicts."""

import math
import shlex
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.parallel import Executor
    from contactgraph_studies.study import Study

_PUBLISHED = Path("results") / "tables"


@dataclass(frozen=True)
class Reproduce:
    """Record, train, test and control: a study, from nothing to a table.

    The studies: results, every data set beside its baselines; pickup, multi-pickup, door, franka
    and all (the first three), the paper's claims; cost, learned costs in scenes without
    demonstrations; rehearsal, an arm's protocol and a camera. The same command continues an
    interrupted study; finished jobs are kept. Tables are copied to results/tables.
    """

    study: Positional[Annotated[str, arg(metavar="STUDY")]] = "all"
    """The study: results, all, pickup, multi-pickup, door, franka, cost or rehearsal."""
    quick: bool = False
    """One seed, short trainings and few test scenes, which only show that everything runs; in the
    place of all tasks pickup alone."""
    only: Annotated[str | None, arg(metavar="NAMES", help_behavior_hint="(all)")] = None
    """Data sets of results to measure, separated by commas; numbers of others are kept."""
    seeds: Annotated[int | None, arg(metavar="N", help_behavior_hint="(3)")] = None
    """Trainings of each data set of results."""
    gate: bool = False
    """Of results, one training, without baselines, in few scenes: the numbers of this state of
    the code in one file, gate.json, within an hour on two cores."""
    against: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(none)")] = None
    """With --gate: a gate.json of another state; what is worse now than the noise between
    trainings is printed, and the exit code is 1."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The folder of all outputs: build/STUDY, if not given."""
    hours: Annotated[float | None, arg(metavar="H", help_behavior_hint="(until done)")] = None
    """After these hours start nothing more, and write what is known; the same command goes on."""
    resume: bool = False
    """Take what results.json holds for measured, where the commands' own files are gone."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: one job per core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.cli.options import check_range
        from contactgraph.data import InvalidInputError
        from contactgraph_studies.gate import read_gate
        from contactgraph_studies.job import JobRecords
        from contactgraph_studies.outputs import publish, write_study
        from contactgraph_studies.runner import run_reported

        study = self._study()
        before = None if self.against is None else read_gate(self.against)
        folder = self.out or self._folder()
        if folder.exists() and not folder.is_dir():
            raise InvalidInputError(f"--out: {folder} must be a folder, found a file")
        for reason in study.left_out:
            print(f"left out: {reason}", file=sys.stderr)
        if self.hours is not None:
            check_range("--hours", self.hours, 0, 10_000)
        seconds = math.inf if self.hours is None else 3600.0 * self.hours
        restored = [*study.kept_jobs, *(study.jobs if self.resume else ())]
        records = JobRecords(folder, version("contactgraph"))
        published = _PUBLISHED / f"{self.study}.json"
        for kept in (folder / "results.json", *([published] if self._publishes else ())):
            records.restore(restored, kept)
        with self._executor() as executor:
            failures = run_reported(study.jobs, records, executor, seconds)
            cores = executor.workers
        if self.gate:
            self._judge(study, folder, before)
        else:
            write_study(study, folder, self._command(), failures, cores)
            if self._publishes:
                publish(study, folder, _PUBLISHED, self.study)
        if failures:
            sys.exit(1)  # the report is written, but incomplete

    @property
    def _publishes(self) -> bool:
        """Whether tables go to `_PUBLISHED`, and ``--resume`` may go on from the numbers there.

        The numbers of another state of the code are no part of a gate.
        """
        return self.out is None and not self.quick and not self.gate

    def _study(self) -> "Study":
        from contactgraph.cli.options import check_range
        from contactgraph.data import InvalidInputError
        from contactgraph.data.lookup import choice
        from contactgraph_studies.results_study import ResultsStudy

        if self.quick and self.gate:
            raise InvalidInputError("--gate: not with --quick, whose numbers are worth nothing")
        if self.against is not None and not self.gate:
            raise InvalidInputError("--against: only with --gate")
        study = choice("study", self.study, _studies(self.quick, self.gate))
        if not isinstance(study, ResultsStudy):
            given = {"--only": self.only, "--seeds": self.seeds, "--gate": self.gate or None}
            for flag, value in given.items():
                if value is not None:
                    raise InvalidInputError(
                        f"{flag}: the study must be results, found {self.study}"
                    )
            return study
        if self.seeds is not None:
            check_range("--seeds", self.seeds, 1, 100)
            study = replace(study, amounts=replace(study.amounts, seeds=tuple(range(self.seeds))))
        return study if self.only is None else study.restricted(self.only)

    def _folder(self) -> Path:
        if self.gate:
            from contactgraph_studies.gate import sources_digest

            return Path("build") / "gate" / sources_digest()
        return Path("build") / ("quick" if self.quick else "") / self.study

    def _command(self) -> str:
        quick = " --quick" if self.quick else ""
        seeds = "" if self.seeds is None else f" --seeds {self.seeds}"
        only = "" if self.only is None else f" --only {shlex.quote(self.only)}"
        return f"contactgraph reproduce {self.study}{quick}{seeds}{only}"

    def _judge(self, study: "Study", folder: Path, before: "dict[str, Any] | None") -> None:
        """Write the gate's file, and compare it with an earlier one."""
        from contactgraph_studies.gate import compare, read_gate, spreads, write_gate
        from contactgraph_studies.results_study import ResultsStudy

        assert isinstance(study, ResultsStudy)
        path = folder / "gate.json"
        rows = [row for row in study.rows(folder) if study.measures(row.data)]
        write_gate(path, rows)
        print(f"the numbers of this state: {path}")
        if before is None:
            return
        table = _PUBLISHED / "results.csv"
        if not table.is_file():
            print(f"{table} is not here: the noise between trainings is taken for 10 %")
        if study.only:
            names = {row.name for row in rows}
            kept = {row: each for row, each in before["numbers"].items() if row in names}
            before = before | {"numbers": kept}
        worse = list(compare(before, read_gate(path), spreads(table)))
        print("\n".join(worse) if worse else "nothing is worse than noise explains")
        if worse:
            sys.exit(1)

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


def _studies(quick: bool, gate: bool) -> "dict[str, Study]":
    from contactgraph_studies.cost.config import COST_TASKS, FULL_COST, QUICK_COST
    from contactgraph_studies.cost.study import CostStudy
    from contactgraph_studies.data_sets import FULL, GATE, QUICK
    from contactgraph_studies.paper import config
    from contactgraph_studies.paper.study import ModelStudy
    from contactgraph_studies.results_study import ResultsStudy
    from contactgraph_studies.simulated_robot import FULL_SIM, QUICK_SIM, SimulatedRobotStudy

    amounts = config.QUICK if quick else config.FULL
    tasks = (config.PICKUP,) if quick else config.TASKS
    return {
        "results": ResultsStudy(QUICK if quick else GATE if gate else FULL),
        **{task.name: ModelStudy((task,), amounts) for task in config.EVERY_TASK},
        "all": ModelStudy(tasks, amounts),
        "cost": CostStudy(COST_TASKS, QUICK_COST if quick else FULL_COST),
        "rehearsal": SimulatedRobotStudy(QUICK_SIM if quick else FULL_SIM),
    }
