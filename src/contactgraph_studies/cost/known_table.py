"""The table of known answers: hidden costs beside those that were learned."""

from collections.abc import Sequence
from pathlib import Path

from contactgraph_studies.cost.cells import Place
from contactgraph_studies.cost.declared import CostAmounts, CostTask, known_answers
from contactgraph_studies.cost.known_answer import KnownAnswer, known_answer, known_terms
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.page_table import PageTable, TableRow
from contactgraph_studies.results import Figure
from contactgraph_studies.words import with_range


def known_table(
    folder: Path,
    wanted: Sequence[Measurement[Place]],
    tasks: Sequence[CostTask],
    amounts: CostAmounts,
) -> PageTable:
    """For the study's page, from what is in the folder."""
    return PageTable(
        slug="known-answer",
        title="A known answer",
        caption="Costs learned from runs of MPC with a cost that is known, beside that cost. "
        "What it costs to be off for one step, as the force that costs as much: a factor on the "
        "whole cost, which no run tells, drops out. Median of the seeds, with their range. An LQR "
        "knows of no largest force, so steps in which the force is as large as it may be mislead "
        "it.",
        heads=(
            *("Task", "Demonstrated by", "Term", "Off by", "hidden, N", "learned, N"),
            *("learned over hidden", "steps at the largest force, %"),
        ),
        rows=[
            row
            for task in tasks
            for lesson in known_answers(amounts)
            for row in known_rows(
                (task.name, lesson.name), known_answer(folder, wanted, task, lesson)
            )
        ],
    )


def known_rows(names: tuple[str, str], answers: Sequence[KnownAnswer]) -> list[TableRow]:
    """A row a term; ``names`` are of task and demonstrator."""
    at_limit = with_range(Figure(tuple(100.0 * each.at_limit for each in answers)))
    return [
        TableRow(
            (*names, term.name, term.unit),
            (with_range(term.hidden), with_range(term.learned), with_range(term.ratio), at_limit),
        )
        for term in known_terms(answers)
    ]
