"""The table of the study of worlds: every task beside all baselines."""

from collections.abc import Iterator, Sequence
from typing import Any

from contactgraph_studies.results import Quantity, joined
from contactgraph_studies.runner import reason_missing
from contactgraph_studies.tables import DASH, StudyTable, counts, number_text
from contactgraph_studies.world_row import EDGES, ERRORS, INFERRED, MEASURED, WorldRow
from contactgraph_studies.worlds import Source

_CLOSED = {"_mpc": Source.mpc, "_scripted": Source.scripted, "_fixed_start": Source.fixed_start}
_HEADINGS = {
    "row": "task",
    MEASURED: "ours, contacts measured",
    INFERRED: "ours, by motion alone",
    "constant_velocity_cm": "constant velocity",
    "standing_still_cm": "standing still",
    "frozen_contact_cm": "frozen contact (oracle)",
    "least_squares_cm": "least squares",
    "gnn_cm": "interaction network",
    "verdict": "verdict",
    "edge_f1_now_inferred": "edge F1, by motion alone",
    "edge_f1_now": "edge F1, measured",
    "_mpc": "success of MPC, each training",
    "_scripted": "scripted",
    "_fixed_start": "fixed start",
    "training_s": "training, s",
}
_NULL = {
    INFERRED: "no body moves, or the model infers no contact from motion",
    "frozen_contact_cm": "the data lack masses, contacts or forces",
    "least_squares_cm": "its prediction is not finite",
    "gnn_cm": "its prediction is not finite",
    "edge_f1_now": "no edge is labelled or believed active",
    "edge_f1_now_inferred": "no edge is labelled or believed active",
}
_RATE = Quantity("success_rate")
_SOURCES = {
    Source.open_loop: "errors and edges",
    Source.mpc: "success of MPC",
    Source.scripted: "scripted",
    Source.fixed_start: "fixed start",
}


def _cells(row: WorldRow) -> dict[str, Any]:
    """The row of the table, by name of the column."""
    open_loop = row.results.readings(row.condition(Source.open_loop))
    successes = {
        name: row.results.success(row.condition(source)) for name, source in _CLOSED.items()
    }
    return {
        "row": row.name,
        "world": row.world.slug,
        "scenes": row.scenes.slug,
        "trainings": len(open_loop),
        **row.errors,
        "_bold": row.smallest,
        "verdict": row.verdict or DASH,
        **row.edges,
        **{name: one or DASH for name, one in successes.items()},
        **{key: each for name, one in successes.items() for key, each in counts(one, name).items()},
        "training_s": row.training_s,
        "command_open_loop": row.errors[MEASURED].command,
        "command_mpc": row.results.statistic(row.condition(Source.mpc), _RATE).command,
    }


def _notes(row: WorldRow) -> Iterator[tuple[str, str]]:
    """Names of columns with nothing to show, and the reason."""
    if row.world.missing is not None:
        yield "all", row.world.missing
        return
    jobs = row.measurements
    reasons = [(one, reason_missing(one.job, row.records)) for one in jobs]
    lost = {one: reason for one, reason in reasons if reason is not None}
    if len(lost) == len(jobs) and len(set(lost.values())) == 1:
        yield "all", next(iter(lost.values()))
        return
    for one, reason in lost.items():
        trained = one.condition.source in (Source.open_loop, Source.mpc)
        seed = f" (training {one.seed})" if trained else ""
        yield f"{_SOURCES[one.condition.source]}{seed}", reason
    measured = row.results.readings(row.condition(Source.open_loop))
    if measured:
        least_squares = measured[0].values.get("least_squares_missing")
        for name, statistic in {**row.errors, **row.edges}.items():
            if not statistic.known:
                reason = _NULL.get(name, "no body moves")
                yield _HEADINGS[name], (name == "least_squares_cm" and least_squares) or reason
    if not row.world.controlled:
        yield "success", "nothing is controlled"
    elif not row.world.has_fixed_start:
        yield _SOURCES[Source.fixed_start], "the task has none"
    if row.world.shipped_runs:
        yield (
            "training",
            f"the model that ships with the package, trained once on "
            f"{row.world.shipped_runs} trajectories; only the test data are new",
        )


def world_table(rows: Sequence[WorldRow]) -> StudyTable:
    """One row for each world and test condition; the reasons for empty cells stand below it."""
    numbers = (*ERRORS, *EDGES, "training_s")
    return StudyTable(
        slug="table",
        title="Every task",
        caption="Errors in cm over the bodies that move, 0.5 s ahead from every state of recorded "
        "trajectories that no model has seen: median over trainings, with their range in "
        "brackets. The smallest learned error of a row is bold. Ours with contacts measured is "
        "told contacts up to a window's start; by motion alone, as least squares and the "
        "interaction network, it is not. Frozen contact is told the true masses and contacts. "
        "Edge F1: the belief about the step just made, corrected by what was observed. Success: "
        "in the same scenes for every controller, trainings side by side, with the 95 % interval "
        "over distinct scenes. A row's commands show when the pointer rests on it.",
        headings=_HEADINGS,
        texts=dict.fromkeys(numbers, number_text),
        rows=[_cells(row) for row in rows],
        notes=_merged([(row.name, *note) for row in rows for note in _notes(row)]),
    )


def _merged(notes: Sequence[tuple[str, str, str]]) -> list[str]:
    """One sentence for each row and reason, with the columns that have it."""
    columns: dict[tuple[str, str], list[str]] = {}
    for row, column, reason in notes:
        columns.setdefault((row, reason), []).append(column)
    return [f"{row}: {joined(names)}: {reason}" for (row, reason), names in columns.items()]
