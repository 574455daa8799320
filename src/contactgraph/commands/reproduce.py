"""``contactgraph reproduce``: the paper's study, from nothing to a page with verdicts."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Reproduce:
    """Record, train and test every model of the paper, and say which of its claims hold.

    With cost: learn costs from demonstrations, and control with them where none was. Goes on where
    it was stopped: what the same command has made already is not done again.
    """

    study: Positional[Annotated[str, arg(metavar="STUDY")]] = "all"
    """The study: pickup, multi-pickup, door, all of these (all), franka (an arm), or cost."""
    quick: bool = False
    """One seed and few test scenes: half an hour on two cores for all tasks."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The folder to write; results/study for all, results/STUDY for another, if not given."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: a cell a core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.commands.engines import engine_of
        from contactgraph.commands.names import looked_up
        from contactgraph.commands.study import Study
        from contactgraph.data import InvalidInputError
        from contactgraph.reproduce.cost.declared import COST_TASKS, FULL_COST, QUICK_COST
        from contactgraph.reproduce.cost.study import CostStudy
        from contactgraph.reproduce.declared import EVERY_TASK, FULL, QUICK, TASKS
        from contactgraph.reproduce.findings import StudyPlan
        from contactgraph.reproduce.model_study import ModelStudy

        amounts = QUICK if self.quick else FULL
        studies: dict[str, StudyPlan] = {
            **{task.name: ModelStudy((task,), amounts) for task in EVERY_TASK},
            "cost": CostStudy(COST_TASKS, QUICK_COST if self.quick else FULL_COST),
            "all": ModelStudy(TASKS, amounts),
        }
        plan = looked_up("study", self.study, studies)
        folder = self.out or Path("results") / ("study" if self.study == "all" else self.study)
        if folder.exists() and not folder.is_dir():
            raise InvalidInputError(f"--out: {folder} must be a folder, found a file")
        option = " --quick" if self.quick else ""
        study = Study(
            plan=plan,
            folder=folder,
            command=f"contactgraph reproduce {self.study}{option}",
        )
        with engine_of(self.cluster) as engine:
            failures = study.measure(engine)
            cores = engine.workers
        study.write(failures, cores)
        if failures:
            # The page is written all the same; the exit code says that it is not whole.
            sys.exit(1)
