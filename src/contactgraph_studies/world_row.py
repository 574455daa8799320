"""One row of the table of worlds: errors, edges, verdict and success, and reasons for gaps."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from contactgraph.cli.task_types import TestCondition
from contactgraph.viz.metric_table import short
from contactgraph_studies.job import JobRecords, Measurement
from contactgraph_studies.results import Quantity, Results, SeedStatistic, joined, moving_error
from contactgraph_studies.worlds import (
    Source,
    World,
    WorldAmounts,
    WorldCondition,
    WorldTraining,
    world_measurements,
)

MEASURED, INFERRED = "measured_cm", "inferred_cm"
ERRORS = {
    MEASURED: moving_error("n_step_rmse_moving_m", Quantity("n_step_rmse_m", null=math.inf)),
    INFERRED: moving_error(
        "n_step_rmse_moving_inferred_m", Quantity("n_step_rmse_inferred_m", null=math.inf)
    ),
    "constant_velocity_cm": Quantity("constant_velocity_rmse_moving_m", "cm", 100.0),
    "standing_still_cm": Quantity("standing_still_rmse_moving_m", "cm", 100.0),
    "frozen_contact_cm": Quantity("frozen_contact_rmse_moving_m", "cm", 100.0),
    "least_squares_cm": Quantity("least_squares_rmse_moving_m", "cm", 100.0),
    "gnn_cm": Quantity("gnn_rmse_moving_m", "cm", 100.0),
}
BASELINES = {
    "constant_velocity_cm": "constant velocity",
    "standing_still_cm": "standing still",
    "least_squares_cm": "least squares",
    "gnn_cm": "the interaction network",
    "frozen_contact_cm": "frozen contact",
}
_LEARNED = (MEASURED, INFERRED, "least_squares_cm", "gnn_cm")
EDGES = ("edge_f1_now_inferred", "edge_f1_now")
_VERDICTS = ("better than all", "better than constant velocity", "no better")


@dataclass(frozen=True)
class WorldRow:
    """A world under one test condition, with everything that is known about it."""

    world: World
    scenes: TestCondition
    amounts: WorldAmounts
    results: Results
    records: JobRecords

    @property
    def name(self) -> str:
        """The label of the row."""
        return self.world.row_name(self.scenes)

    def condition(self, source: Source) -> WorldCondition:
        """The labels of its numbers."""
        return WorldCondition(self.world.slug, self.scenes.slug, source)

    @cached_property
    def errors(self) -> Mapping[str, SeedStatistic]:
        """Errors by name of the column, cm."""
        where = self.condition(Source.open_loop)
        return {name: self.results.statistic(where, each) for name, each in ERRORS.items()}

    @cached_property
    def edges(self) -> Mapping[str, SeedStatistic]:
        """Edge F1 of the step just made, by name of the column."""
        where = self.condition(Source.open_loop)
        return {name: self.results.statistic(where, Quantity(name)) for name in EDGES}

    @cached_property
    def training_s(self) -> SeedStatistic:
        """Wall time of the trainings that are done, s."""
        trainings = (WorldTraining(self.world, seed, self.amounts).job for seed in self.seeds)
        times = (None if job is None else self.records.seconds(job) for job in trainings)
        return SeedStatistic(tuple(each for each in times if each is not None), unit="s")

    @property
    def smallest(self) -> frozenset[str]:
        """Columns of the smallest learned error, as displayed."""
        learned = {name: self.errors[name].median for name in _LEARNED}
        shown = {name: short(one) for name, one in learned.items() if math.isfinite(one)}
        least = min(shown.values(), key=float, default="")
        return frozenset(name for name, text in shown.items() if text == least)

    @property
    def verdict(self) -> str:
        """The trainings' own verdicts, and the baselines with a smaller median error."""
        readings = self.results.readings(self.condition(Source.open_loop))
        counts = Counter(one.values.get("verdict") for one in readings)
        found = [each for each in _VERDICTS if counts[each]]
        if not found:
            return ""
        parts = found if len(found) == 1 else [f"{each} ({counts[each]})" for each in found]
        behind = {name: self._behind(name) for name in (MEASURED, INFERRED)}
        text = ", ".join(parts)
        if behind[MEASURED]:
            text += f"; behind {joined(behind[MEASURED])}"
        if behind[INFERRED] and behind[INFERRED] != behind[MEASURED]:
            text += f"; by motion alone behind {joined(behind[INFERRED])}"
        return text

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of its trainings."""
        return self.amounts.seeds_of(self.world)

    @property
    def measurements(self) -> list[Measurement]:
        """All that the row shows."""
        every = world_measurements([self.world], self.amounts)
        return [one for one in every if one.condition.scenes == self.scenes.slug]

    def _behind(self, ours: str) -> list[str]:
        """Baselines with a smaller median error."""
        mine = self.errors[ours]
        return [
            words
            for name, words in BASELINES.items()
            if mine.known and self.errors[name].known and self.errors[name].median < mine.median
        ]
