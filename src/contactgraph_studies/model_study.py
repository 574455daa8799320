"""The paper's study of models: what they predict, and how control by them goes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.claim import Claim
from contactgraph_studies.claims import claims
from contactgraph_studies.declared import Amounts, StudyTask
from contactgraph_studies.findings import Findings
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.pictures import figure_pictures, scene_pictures
from contactgraph_studies.plan_cells import Where, measurements
from contactgraph_studies.results import Results
from contactgraph_studies.study_table import csv_rows, markdown_rows, page_table, rows
from contactgraph_studies.targets import targets


@dataclass(frozen=True)
class ModelStudy:
    """Some tasks, and so much of everything."""

    tasks: Sequence[StudyTask]
    amounts: Amounts

    @cached_property
    def wanted(self) -> list[Measurement[Where]]:
        """All that is measured."""
        return measurements(self.tasks, self.amounts)

    @cached_property
    def cells(self) -> list[Cell]:
        """All that is made for it, in order of need."""
        return in_order(one.cell for one in self.wanted)

    def findings(self, folder: Path) -> Findings:
        """Claims, tables and figures."""
        results = Results.read(folder, self.wanted)
        found = claims(results, self.tasks, self.amounts)
        table = rows(results, self.tasks, self.amounts)
        figures = figure_pictures(folder, results, table, self.tasks, self.amounts)
        scenes, insights = scene_pictures(folder, self.tasks, self.wanted)
        return Findings(
            title="A contact graph, claim by claim",
            summary=f"What the paper says, measured anew: {_told(found)} "
            f"{len(self.amounts.seeds)} training seed(s), {self.amounts.episodes} closed-loop "
            "episodes a cell, in scenes that no training has seen.",
            claims=found,
            asked="What GIM-Temp must reach",
            targets=targets(results, self.tasks, self.amounts.seeds),
            tables=[page_table(table)],
            table_markdown=markdown_rows(table),
            table_csv=csv_rows(table),
            figures=[*figures, *insights],
            scenes=scenes,
            amounts={
                "training_seeds": list(self.amounts.seeds),
                "test_runs": self.amounts.test_runs,
                "episodes": self.amounts.episodes,
                "success_episodes": self.amounts.success_episodes,
            },
            readings=self._readings(results),
        )

    def _readings(self, results: Results) -> list[dict]:
        return [
            {
                "source": where.source.name,
                "task": where.task,
                "model": where.model,
                "scenes": where.condition,
                "sensor": where.fault or None,
                "training_runs": where.runs or None,
                "training_seed": reading.seed,
                "command": reading.command,
                "values": reading.values,
            }
            for where in dict.fromkeys(one.where for one in self.wanted)
            for reading in results.readings(where)
        ]


def _told(found: Sequence[Claim]) -> str:
    held = sum(claim.holds is True for claim in found)
    return f"{held} of {len(found)} claims hold for our models."
