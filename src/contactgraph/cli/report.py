"""``contactgraph report``: one page that shows what a model has learned."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from contactgraph.cli.collect import Collect
from contactgraph.cli.control import Control
from contactgraph.cli.evaluate import Evaluate
from contactgraph.cli.options import AUTO, Device, ModelArgument, option_arguments
from contactgraph.data import InvalidInputError

if TYPE_CHECKING:
    from contactgraph.cli.model_report import ConditionResult
    from contactgraph.envs.registry import TestCondition
    from contactgraph.viz import BeliefTimeline, SceneTrajectory


@dataclass(frozen=True)
class Report:
    """Test a model on new scenes, and write a page that shows what it learned and how well."""

    model: ModelArgument
    task: str = "pickup"
    """The task to test it on, e.g. pickup or release."""
    out: Annotated[
        Path | None,
        arg(
            metavar="FILE",
            help_behavior_hint="(default: report/index.html in the run folder, or here)",
        ),
    ] = None
    """The page to write."""
    test_runs: int = 20
    """Recorded trajectories per test condition."""
    episodes: int = 20
    """Closed-loop episodes per test condition."""
    seed: int = 1000
    """Seed of the test scenes."""
    beside: Annotated[
        tuple[str, str] | None, arg(metavar="MODEL TASK", help_behavior_hint="(optional)")
    ] = None
    """Another model and its task, whose inference is shown beside."""
    quick: bool = False
    """Leave out the test conditions that quick studies leave out."""
    device: Device = AUTO

    def run(self) -> None:
        """Test, and write the page."""
        from contactgraph.cli.model_report import (
            loss_curves,
            n_step_errors,
            reliability_curves,
            report_metrics,
        )
        from contactgraph.cli.models import model_path, run_folder
        from contactgraph.cli.output import check_writable, provenance
        from contactgraph.envs.registry import task_spec
        from contactgraph.model.io import describe_model
        from contactgraph.train import RunFolder
        from contactgraph.viz import ReportData, write_report
        from contactgraph.viz.metric_table import markdown_metrics

        if self.test_runs < 1:
            raise InvalidInputError(f"--test-runs must be at least 1, found {self.test_runs}")
        if self.beside is not None:
            model_path(self.beside[0])
            task_spec(self.beside[1])
        training = run_folder(self.model)
        page = self.out or (training or Path()) / "report" / "index.html"
        if page.parent.exists():
            check_writable(page)
        task, summary = task_spec(self.task), describe_model(model_path(self.model))
        cells = page.parent / "cells"
        cells.mkdir(parents=True, exist_ok=True)
        conditions = task.test_conditions(every=not self.quick)
        tested = [self._test(cells, condition) for condition in conditions]
        results, scenes = [result for result, _ in tested], [scene for _, scene in tested]
        timelines = self._timelines(cells, results[0])
        command = f"contactgraph report {self.model} --task {self.task} --seed {self.seed}"
        if self.beside is not None:
            command += " --beside " + " ".join(self.beside)
        if self.quick:
            command += " --quick"
        metrics = report_metrics(results, summary)
        data = ReportData(
            title=f"{task.summary or self.task}: a contact graph",
            summary="A model learned from recorded trajectories of a gripper when bodies touch and "
            "how they move then; iLQR-MPC uses it to do the same in new scenes.",
            metrics=metrics,
            scenes=tuple(scenes),
            beliefs=tuple(timelines),
            errors=tuple(n_step_errors(results)),
            horizon_s=_HORIZON_S,
            reliability=tuple(reliability_curves(results[-1])),
            losses=() if training is None else tuple(loss_curves(RunFolder(training).metrics())),
            versions=provenance()["versions"],
            remake=(command,),
        )
        write_report(page, data)
        print(markdown_metrics(metrics))
        print(f"the report: {page}")

    def _test(
        self, folder: Path, condition: "TestCondition"
    ) -> "tuple[ConditionResult, SceneTrajectory]":
        """Runs the commands of one test condition; their files stay in the folder.

        Also returns the first closed-loop episode, with its plans.
        """
        from contactgraph.cli.model_report import ConditionResult

        pairs = tuple(f"{name}={value!r}" for name, value in condition.options.items())
        data, open_loop = _files(folder, condition.slug)
        Collect(self.task, data, self.test_runs, self.seed, option=pairs).run()
        Evaluate(self.model, data, open_loop).run()
        closed_loop = folder / f"control-{condition.slug}.json"
        scene = Control(
            self.model,
            self.task,
            self.episodes,
            self.seed,
            option=pairs,
            json=closed_loop,
            save=folder / f"control-{condition.slug}.h5",
        ).run()
        options = " ".join(("", *option_arguments(condition.options)))
        result = ConditionResult(
            condition=condition,
            open_loop=_read(open_loop),
            closed_loop=_read(closed_loop),
            open_loop_command=f"contactgraph evaluate {self.model} {data.name}",
            closed_loop_command=f"contactgraph control {self.model} {self.task} "
            f"--episodes {self.episodes} --seed {self.seed}{options}",
        )
        return result, scene(condition.name)

    def _timelines(self, folder: Path, result: "ConditionResult") -> "list[BeliefTimeline]":
        """Beliefs of both models over time, each on scenes as in training, where there are any."""
        from contactgraph.cli.model_report import inferred_beliefs
        from contactgraph.envs.registry import task_spec

        data, _ = _files(folder, result.condition.slug)
        timelines = [inferred_beliefs(self.model, self.task, data, result.open_loop)]
        if self.beside is not None:
            model, task = self.beside
            condition = task_spec(task).test_conditions()[0]
            data, open_loop = _files(folder, f"beside-{condition.slug}")
            Collect(task, data, self.test_runs, self.seed).run()
            Evaluate(model, data, open_loop).run()
            timelines.append(inferred_beliefs(model, task, data, _read(open_loop)))
        return [each for each in timelines if each is not None]


_HORIZON_S = 0.5
"""Of the N-step errors."""


def _files(folder: Path, slug: str) -> tuple[Path, Path]:
    """The recorded trajectories of a test condition, and the measurements on them."""
    return folder / f"test-{slug}.h5", folder / f"evaluate-{slug}.json"


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())
