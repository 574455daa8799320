"""Results of a study of costs that nobody ran: all as the paper would have it, until changed."""

from collections.abc import Callable
from typing import Any

from contactgraph_studies.cost.cells import Controlled, Learned, Place, cost_measurements
from contactgraph_studies.cost.declared import COST_TASKS, FULL_COST, Trial
from contactgraph_studies.results import Reading, Results

Change = dict[str, Any] | Callable[[int], dict[str, Any]]
"""What is otherwise; or that of every seed."""


def by_the_paper(where: Place) -> dict[str, Any]:
    """What a cell would hold if every target were met."""
    if isinstance(where, Learned):
        return {"made": {"seconds": 30.0}, "history": {"imitation": [1.0]}, "Q": [[1.0]]}
    return {
        "success_rate": 0.99,
        "episodes": 100,
        "contact_speed_m_s": 1.5,
        "touched_bystanders": 2,
    }


def cost_results(
    change: Change | None = None, task: str = "", trial: Trial | None = None
) -> Results:
    """By the paper, but for ``change`` in the tests of the task and trial named."""
    readings: dict[Place, list[Reading]] = {}
    for one in cost_measurements(COST_TASKS, FULL_COST):
        where, values = one.where, by_the_paper(one.where)
        if (
            change is not None
            and isinstance(where, Controlled)
            and (not task or where.task == task)
            and (trial is None or where.trial == trial)
        ):
            values.update(change(one.seed) if callable(change) else change)
        readings.setdefault(where, []).append(Reading(one.seed, values, one.cell.command))
    return Results(readings)
