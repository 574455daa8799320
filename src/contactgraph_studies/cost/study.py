"""The study of learned costs: do they do the task where no demonstration was?"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.cost.cells import (
    Controlled,
    Demonstrated,
    Learned,
    Place,
    cost_measurements,
)
from contactgraph_studies.cost.charts import cost_pictures, cost_scenes
from contactgraph_studies.cost.claim import transfers
from contactgraph_studies.cost.declared import SCENE_SEED, CostAmounts, CostTask
from contactgraph_studies.cost.known_table import known_table
from contactgraph_studies.cost.table import cost_csv, cost_rows, cost_table
from contactgraph_studies.cost.targets import cost_targets
from contactgraph_studies.findings import Findings
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.page_table import markdown_table
from contactgraph_studies.results import Reading, Results

_LEFT_OUT = ("history", "in_words")
"""Of a cost file, in the results: long, or the same in all."""

_TOLD = {
    True: "the paper's claim holds",
    False: "the paper's claim does not hold",
    None: "whether the paper's claim holds is not known",
}


@dataclass(frozen=True)
class CostStudy:
    """Some tasks, and so much of everything."""

    tasks: Sequence[CostTask]
    amounts: CostAmounts

    @cached_property
    def wanted(self) -> list[Measurement[Place]]:
        """All that is measured."""
        return cost_measurements(self.tasks, self.amounts)

    @cached_property
    def cells(self) -> list[Cell]:
        """All that is made for it, in order of need."""
        return in_order(one.cell for one in self.wanted)

    def findings(self, folder: Path) -> Findings:
        """The claim, tables and figures."""
        results = Results.read(folder, self.wanted)
        claim = transfers(results, self.tasks, self.amounts)
        rows = cost_rows(results, self.tasks, self.amounts)
        known = known_table(folder, self.wanted, self.tasks, self.amounts)
        tables = [cost_table(rows), known]
        seeds, episodes = self.amounts.seeds, self.amounts.episodes
        return Findings(
            title="A cost, learned from demonstrations",
            summary="What an expert wants, learned from its runs through a differentiable LQR on "
            f"the learned model: {_TOLD[claim.holds]}. {len(seeds)} seed(s) of demonstrations, "
            f"each with one goal; {episodes} closed-loop episodes a seed, with goals and objects "
            "that no demonstration had.",
            claims=[claim],
            asked="What learned costs must reach",
            targets=cost_targets(results, self.tasks, self.amounts),
            tables=tables,
            table_markdown="\n".join(markdown_table(one.heads, one.rows) for one in tables),
            table_csv=cost_csv(rows),
            figures=cost_pictures(folder, results, self.wanted, self.tasks, self.amounts),
            scenes=cost_scenes(folder, self.wanted, self.tasks, self.amounts),
            amounts={
                "demonstration_seeds": list(seeds),
                "demonstrations": list(self.amounts.runs),
                "episodes": episodes,
                "test_scene_seeds": [SCENE_SEED + seed for seed in seeds],
            },
            readings=[
                {**_what(where), **_told(reading)}
                for where in dict.fromkeys(one.where for one in self.wanted)
                for reading in results.readings(where)
            ],
        )


def _told(reading: Reading) -> dict[str, Any]:
    told = {key: value for key, value in reading.values.items() if key not in _LEFT_OUT}
    return {"seed": reading.seed, "command": reading.command, "values": told}


def _what(where: Place) -> dict[str, Any]:
    """What a reading is of, in words."""
    match where:
        case Demonstrated(task):
            return {"source": "control with the task's own cost", "task": task}
        case Learned(task, lesson):
            source, distractors = "learning", None
        case Controlled(task, trial):
            source, lesson, distractors = "control", trial.lesson, trial.distractors
    return {
        "source": source,
        "task": task,
        "learned_from": lesson.name,
        "demonstrations": lesson.runs,
        "distractors": distractors,
    }
