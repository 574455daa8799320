"""The study of contact without a sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.findings import Findings
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.page_table import markdown_table
from contactgraph_studies.results import Results
from contactgraph_studies.sensing.declared import SCENE_SEED, SensingAmounts, SensingTask
from contactgraph_studies.sensing.results import Sensed, sensing_measurements
from contactgraph_studies.sensing.table import sensing_csv, sensing_table
from contactgraph_studies.sensing.targets import sensing_targets


@dataclass(frozen=True)
class SensingStudy:
    """Some tasks, and so much of everything."""

    tasks: Sequence[SensingTask]
    amounts: SensingAmounts

    @cached_property
    def wanted(self) -> list[Measurement[Sensed]]:
        """All that is measured."""
        return sensing_measurements(self.tasks, self.amounts)

    @cached_property
    def cells(self) -> list[Cell]:
        """All that is made for it."""
        return in_order(one.cell for one in self.wanted)

    def findings(self, folder: Path) -> Findings:
        """Targets and table; the paper leaves the question open, so there is no claim of it."""
        results = Results.read(folder, self.wanted)
        table = sensing_table(results, self.tasks)
        seeds, episodes = self.amounts.seeds, self.amounts.episodes
        return Findings(
            title="Contact without a sensor",
            summary="Beliefs about contacts, corrected by how well each hypothesis explains the "
            "motion just observed, beside those that measured contacts correct and those that "
            f"nothing does. The shipped models; {len(seeds)} seed(s) of scenes, {episodes} "
            "episodes each.",
            claims=[],
            asked="What contact without a sensor must reach",
            targets=sensing_targets(results, self.tasks, self.amounts),
            tables=[table],
            table_markdown=markdown_table(table.heads, table.rows),
            table_csv=sensing_csv(results, self.tasks),
            figures=[],
            scenes=[],
            amounts={
                "episodes": episodes,
                "scene_seeds": [SCENE_SEED + seed for seed in seeds],
            },
            readings=[
                {
                    "task": where.task,
                    "condition": where.condition,
                    "contacts_known_by": where.sensor,
                    "seed": reading.seed,
                    "command": reading.command,
                    "values": reading.values,
                }
                for where in dict.fromkeys(one.where for one in self.wanted)
                for reading in results.readings(where)
            ],
        )
