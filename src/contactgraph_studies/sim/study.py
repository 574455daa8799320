"""The study of the paper's real experiment, rehearsed."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.findings import Findings
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.page_table import markdown_table
from contactgraph_studies.results import Results
from contactgraph_studies.sim.cells import Place, rehearsal_measurements
from contactgraph_studies.sim.declared import (
    CONTROL_SEED,
    TRAINING_SEED,
    VALIDATION_SEED,
    RehearsalAmounts,
)
from contactgraph_studies.sim.table import rehearsal_csv, rehearsal_table
from contactgraph_studies.sim.targets import rehearsal_targets


@dataclass(frozen=True)
class RehearsalStudy:
    """So much of everything. Its cells need all of a machine each."""

    amounts: RehearsalAmounts

    @cached_property
    def wanted(self) -> list[Measurement[Place]]:
        """All that is measured."""
        return rehearsal_measurements(self.amounts)

    @cached_property
    def cells(self) -> list[Cell]:
        """All that is made for it."""
        return in_order(one.cell for one in self.wanted)

    def findings(self, folder: Path) -> Findings:
        """Targets and table; the paper's real arm is not here, so no claim of it is judged."""
        results = Results.read(folder, self.wanted)
        table = rehearsal_table(results)
        amounts = self.amounts
        return Findings(
            title="The real experiment, rehearsed",
            summary="A simulated arm behind the real one's protocol, the maker's own client, a "
            "rendered camera with noise and delay, tags found in its frames: "
            f"{amounts.training_runs} runs of {amounts.seconds:g} s to learn from, "
            f"{amounts.validation_runs} to test on, and {amounts.episodes} pickups by MPC with "
            "what was learned. No arm was moved.",
            claims=[],
            asked="What the rehearsal must reach",
            targets=rehearsal_targets(results, amounts),
            tables=[table],
            table_markdown=markdown_table(table.heads, table.rows),
            table_csv=rehearsal_csv(results),
            figures=[],
            scenes=[],
            amounts={
                "training_runs": amounts.training_runs,
                "validation_runs": amounts.validation_runs,
                "seconds": amounts.seconds,
                "episodes": amounts.episodes,
                "seeds": [TRAINING_SEED, VALIDATION_SEED, CONTROL_SEED],
            },
            readings=[
                {
                    "source": str(one.where),
                    "seed": reading.seed,
                    "command": reading.command,
                    "values": reading.values,
                }
                for one in self.wanted
                for reading in results.readings(one.where)
            ],
        )
