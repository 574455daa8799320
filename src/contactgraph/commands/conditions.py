"""Test conditions of a task: each is a few commands, run one after the other in one folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contactgraph.commands.collect import Collect
from contactgraph.commands.control import Control
from contactgraph.commands.evaluate import Evaluate
from contactgraph.reproduce.figures import ConditionResult


@dataclass(frozen=True)
class Conditions:
    """Fresh recorded runs and closed-loop episodes of one task, with more and more distractors."""

    task: str
    distractors: tuple[int, ...]
    test_runs: int
    """Recorded runs a condition, for the open-loop errors."""
    episodes: int
    """Closed-loop episodes a condition."""
    seed: int

    def measure(self, run_name: str, folder: Path, keep: bool) -> list[ConditionResult]:
        """Run every condition's commands; `keep` leaves out those whose output is there already."""
        folder.mkdir(parents=True, exist_ok=True)
        return [self._one(run_name, folder, count, keep) for count in self.distractors]

    def _one(self, run_name: str, folder: Path, distractors: int, keep: bool) -> ConditionResult:
        data = folder / f"test-{distractors}.h5"
        if not (keep and data.exists()):
            Collect(self.task, data, self.test_runs, self.seed, distractors).run()
        open_loop = folder / f"evaluate-{distractors}.json"
        if not (keep and open_loop.exists()):
            Evaluate(run_name, data, open_loop).run()
        closed_loop = folder / f"control-{distractors}.json"
        if not (keep and closed_loop.exists()):
            Control(
                run_name,
                self.task,
                self.episodes,
                self.seed,
                distractors,
                json=closed_loop,
                save=folder / f"control-{distractors}.h5",
            ).run()
        option = f" --distractors {distractors}" if distractors else ""
        return ConditionResult(
            distractors=distractors,
            open_loop=_read(open_loop),
            closed_loop=_read(closed_loop),
            open_loop_command=f"contactgraph evaluate {run_name} {data.name}",
            closed_loop_command=f"contactgraph control {run_name} {self.task} "
            f"--episodes {self.episodes} --seed {self.seed}{option}",
            seed=self.seed,
        )


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())
