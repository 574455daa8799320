"""``contactgraph reproduce``: the paper's study, from nothing to a page with verdicts."""

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.parallel import Executor
    from contactgraph_studies.findings import StudyPlan


@dataclass(frozen=True)
class Reproduce:
    """Record, train and test every model of the paper, and say which of its claims hold.

    With cost: learn costs from demonstrations, and control with them where none was. With sensing:
    control without a contact sensor. With rehearsal: record, train and control through an arm's
    protocol and a camera. Goes on where it was stopped: what the same command has made already is
    not done again.
    """

    study: Positional[Annotated[str, arg(metavar="STUDY")]] = "all"
    """The study: pickup, multi-pickup, door, all of these (all), franka (an arm), cost, sensing, or
    rehearsal."""
    quick: bool = False
    """One seed and few test scenes: half an hour on two cores for all tasks."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The folder to write; results/study for all, results/STUDY for another, if not given."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: a cell a core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.cli.options import choice
        from contactgraph.data import InvalidInputError
        from contactgraph_studies.cli.study import Study
        from contactgraph_studies.cost.declared import COST_TASKS, FULL_COST, QUICK_COST
        from contactgraph_studies.cost.study import CostStudy
        from contactgraph_studies.declared import EVERY_TASK, FULL, QUICK, TASKS
        from contactgraph_studies.findings import StudyPlan
        from contactgraph_studies.model_study import ModelStudy
        from contactgraph_studies.sensing.declared import (
            FULL_SENSING,
            QUICK_SENSING,
            SENSING_TASKS,
        )
        from contactgraph_studies.sensing.study import SensingStudy
        from contactgraph_studies.sim.declared import FULL_REHEARSAL, QUICK_REHEARSAL
        from contactgraph_studies.sim.study import RehearsalStudy

        amounts = QUICK if self.quick else FULL
        studies: dict[str, StudyPlan] = {
            **{task.name: ModelStudy((task,), amounts) for task in EVERY_TASK},
            "cost": CostStudy(COST_TASKS, QUICK_COST if self.quick else FULL_COST),
            "sensing": SensingStudy(SENSING_TASKS, QUICK_SENSING if self.quick else FULL_SENSING),
            "rehearsal": RehearsalStudy(QUICK_REHEARSAL if self.quick else FULL_REHEARSAL),
            "all": ModelStudy(TASKS, amounts),
        }
        plan = choice("study", self.study, studies)
        folder = self.out or Path("results") / ("study" if self.study == "all" else self.study)
        if folder.exists() and not folder.is_dir():
            raise InvalidInputError(f"--out: {folder} must be a folder, found a file")
        option = " --quick" if self.quick else ""
        study = Study(
            plan=plan,
            folder=folder,
            command=f"contactgraph reproduce {self.study}{option}",
        )
        with self._executor(plan) as executor:
            failures = study.measure(executor)
            cores = executor.workers
        study.write(failures, cores)
        if failures:
            # The page is written all the same; the exit code says that it is not whole.
            sys.exit(1)

    def _executor(self, plan: "StudyPlan") -> "AbstractContextManager[Executor]":
        """Who makes the cells of a plan."""
        from contactgraph.cli.options import open_executor
        from contactgraph.data import InvalidInputError
        from contactgraph.parallel import LocalExecutor
        from contactgraph_studies.sim.study import RehearsalStudy

        if not isinstance(plan, RehearsalStudy):
            return open_executor(self.cluster)
        if self.cluster != "local":
            raise InvalidInputError(
                f"--cluster: a rehearsal is held on this machine (local), found {self.cluster!r}"
            )
        # Server, camera, planner and loop keep time together, on all cores there are.
        return nullcontext(LocalExecutor(whole_machine=True))
