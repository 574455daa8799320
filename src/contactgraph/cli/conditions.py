"""Test conditions of a task: each is a few commands, run one after the other in one folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contactgraph.cli.collect import Collect
from contactgraph.cli.control import Control
from contactgraph.cli.evaluate import Evaluate
from contactgraph.viz.model_report import ConditionResult
from contactgraph_studies.declared import StudyTask, TestCondition


@dataclass(frozen=True)
class Conditions:
    """Fresh recorded runs and closed-loop episodes of one task, in harder and harder scenes."""

    task: StudyTask
    test_runs: int
    """Recorded runs a condition, for the open-loop errors."""
    episodes: int
    """Closed-loop episodes a condition."""
    seed: int

    def measure(self, model_name: str, folder: Path) -> tuple[ConditionResult, ...]:
        """Run every condition's commands; what they write is left in the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        return tuple(self._one(model_name, folder, condition) for condition in self.task.conditions)

    def _one(self, model_name: str, folder: Path, condition: TestCondition) -> ConditionResult:
        task, distractors, objects = self.task.name, condition.distractors, condition.objects
        data = folder / f"test-{condition.slug}.h5"
        Collect(task, data, self.test_runs, self.seed, distractors, objects).run()
        open_loop = folder / f"evaluate-{condition.slug}.json"
        Evaluate(model_name, data, open_loop).run()
        closed_loop = folder / f"control-{condition.slug}.json"
        Control(
            model_name,
            task,
            self.episodes,
            self.seed,
            distractors,
            objects,
            json=closed_loop,
            save=folder / f"control-{condition.slug}.h5",
        ).run()
        options = " ".join(("", *condition.options))
        return ConditionResult(
            condition=condition,
            open_loop=_read(open_loop),
            closed_loop=_read(closed_loop),
            open_loop_command=f"contactgraph evaluate {model_name} {data.name}",
            closed_loop_command=f"contactgraph control {model_name} {task} "
            f"--episodes {self.episodes} --seed {self.seed}{options}",
            seed=self.seed,
        )


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())
