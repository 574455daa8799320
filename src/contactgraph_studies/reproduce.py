"""The command ``contactgraph reproduce``: a study, from nothing to a page of verdicts."""

import math
import shlex
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.parallel import Executor
    from contactgraph_studies.study import Study


@dataclass(frozen=True)
class Reproduce:
    """Record, train and test every model of the paper, and judge the paper's claims.

    With worlds: train on every task, and compare with baselines. With inference: judge the filter
    of contacts, and what is lost without it. With cost: learn costs from
    demonstrations, and control in scenes without demonstrations. With sensing: control without a
    contact sensor. With rehearsal: record, train and control through an arm's protocol and a
    camera. The same command continues an interrupted study; finished jobs are kept.
    """

    study: Positional[Annotated[str, arg(metavar="STUDY")]] = "all"
    """The study: pickup, multi-pickup, door, all of these (all), franka (an arm), worlds,
    inference, cost, sensing, or rehearsal."""
    quick: bool = False
    """One seed, short trainings and few test scenes, which only show that everything runs; in the
    place of all tasks pickup alone."""
    only: Annotated[str | None, arg(metavar="NAMES", help_behavior_hint="(all)")] = None
    """Tasks of worlds or inference to measure, separated by commas; the others are shown as they
    are."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """The folder to write; results/study for all, results/STUDY for another, if not given."""
    hours: Annotated[float | None, arg(metavar="H", help_behavior_hint="(until done)")] = None
    """After these hours start nothing more, and write what is known; the same command goes on."""
    resume: bool = False
    """Take what results.json holds for measured, where the commands' own files are gone."""
    check: Annotated[int | None, arg(metavar="N", help_behavior_hint="(none)")] = None
    """Measure N numbers that results.json holds again, drawn at random, and compare; nothing is
    written. Of pickup, multi-pickup, door, franka and all."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: one job per core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.cli.options import check_range, choice
        from contactgraph.data import InvalidInputError
        from contactgraph_studies.page import write_study
        from contactgraph_studies.runner import run_reported
        from contactgraph_studies.world_study import StudyOfWorlds

        study = choice("study", self.study, _studies(self.quick))
        if self.only is not None:
            if not isinstance(study, StudyOfWorlds):
                raise InvalidInputError(
                    f"--only: the study must be worlds or inference, found {self.study}"
                )
            study = study.restricted(self.only)
        folder = self.out or Path("results") / ("study" if self.study == "all" else self.study)
        if folder.exists() and not folder.is_dir():
            raise InvalidInputError(f"--out: {folder} must be a folder, found a file")
        if self.check is not None:
            self._check(study, folder, self.check)
            return
        for reason in study.left_out:
            print(f"left out: {reason}", file=sys.stderr)
        if self.hours is not None:
            check_range("--hours", self.hours, 0, 10_000)
        seconds = math.inf if self.hours is None else 3600.0 * self.hours
        with self._executor() as executor:
            failures = run_reported(study.jobs, folder, executor, seconds, self.resume)
            cores = executor.workers
        quick = " --quick" if self.quick else ""
        only = "" if self.only is None else f" --only {shlex.quote(self.only)}"
        command = f"contactgraph reproduce {self.study}{quick}{only}"
        write_study(study, folder, command, failures, cores)
        if failures:
            sys.exit(1)  # the page is written, but incomplete

    def _check(self, study: "Study", folder: Path, count: int) -> None:
        from contactgraph.data import InvalidInputError
        from contactgraph_studies.paper.repeated import repeat
        from contactgraph_studies.paper.study import ModelStudy

        if not isinstance(study, ModelStudy):
            raise InvalidInputError(f"--check: not of the study {self.study}")
        with self._executor() as executor:
            found = repeat(study, folder, count, executor)
        print("\n".join(map(str, found)))
        agree = sum(one.agrees for one in found)
        print(f"{agree} of {len(found)} agree")
        if agree < len(found):
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


def _studies(quick: bool) -> "dict[str, Study]":
    from contactgraph_studies.cost.config import COST_TASKS, FULL_COST, QUICK_COST
    from contactgraph_studies.cost.study import CostStudy
    from contactgraph_studies.inference_jobs import INFERENCE_WORLDS
    from contactgraph_studies.inference_study import InferenceStudy
    from contactgraph_studies.paper.config import EVERY_TASK, FULL, PICKUP, QUICK, TASKS
    from contactgraph_studies.paper.study import ModelStudy
    from contactgraph_studies.sensing import FULL_SENSING, QUICK_SENSING, SensingStudy
    from contactgraph_studies.simulated_robot import FULL_SIM, QUICK_SIM, SimulatedRobotStudy
    from contactgraph_studies.world_study import WorldStudy
    from contactgraph_studies.worlds import FULL_WORLDS, QUICK_WORLDS

    amounts = QUICK if quick else FULL
    world_amounts = QUICK_WORLDS if quick else FULL_WORLDS
    return {
        **{task.name: ModelStudy((task,), amounts) for task in EVERY_TASK},
        "worlds": WorldStudy(world_amounts),
        "inference": InferenceStudy(world_amounts, INFERENCE_WORLDS),
        "cost": CostStudy(COST_TASKS, QUICK_COST if quick else FULL_COST),
        "sensing": SensingStudy(QUICK_SENSING if quick else FULL_SENSING),
        "rehearsal": SimulatedRobotStudy(QUICK_SIM if quick else FULL_SIM),
        "all": ModelStudy((PICKUP,) if quick else TASKS, amounts),
    }
