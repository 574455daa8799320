"""The rehearsed experiment's table: what was recorded, predicted and controlled."""

import csv
import io
from collections.abc import Sequence

from contactgraph_studies.page_table import PageTable, TableRow
from contactgraph_studies.results import Results
from contactgraph_studies.sim.cells import (
    TRAINING,
    VALIDATION,
    Controlled,
    Followed,
    Place,
)
from contactgraph_studies.sim.declared import WAYS
from contactgraph_studies.words import short

_HEADS = ("What", "number", "unit", "value")
_MM, _CM, _MS = 1000.0, 100.0, 1000.0
_RECORDED = (
    ("runs", "", 1.0),
    ("completed", "runs", 1.0),
    ("with_grasp", "runs", 1.0),
    ("held_at_some_time", "runs", 1.0),
    ("rate_hz", "Hz", 1.0),
    ("position_error_m", "mm", _MM),
    ("position_error_p95_m", "mm", _MM),
    ("position_error_worst_m", "mm", _MM),
    ("hand_error_worst_m", "mm", _MM),
)
_FOLLOWED = (
    *((f"n_step_rmse_{how}m", "cm", _CM) for how in ("", "unmeasured_", "inferred_")),
    *((f"{floor}_rmse_m", "cm", _CM) for floor in ("constant_velocity", "frozen_contact")),
    *((f"edge_f1{how}", "", 1.0) for how in ("", "_unmeasured", "_inferred")),
    *((f"switch_time_error{how}_s", "ms", _MS) for how in ("", "_unmeasured", "_inferred")),
)
_CONTROLLED = (
    ("successes", "episodes", 1.0),
    ("episodes", "episodes", 1.0),
    ("contact_speed_m_s", "m/s", 1.0),
    ("rate_hz", "Hz", 1.0),
    ("plan_ms_p50", "ms", 1.0),
    ("plan_ms_p99", "ms", 1.0),
)


def _every() -> list[tuple[str, Place, tuple[tuple[str, str, float], ...]]]:
    return [
        ("training runs", TRAINING, _RECORDED),
        ("validation runs", VALIDATION, _RECORDED),
        ("predictions, smoothed states", Followed(live=False), _FOLLOWED),
        ("predictions, states as known then", Followed(live=True), _FOLLOWED),
        *((f"control, contacts {way.name}", Controlled(way), _CONTROLLED) for way in WAYS),
    ]


def _numbers(results: Results) -> list[tuple[str, str, str, float, str]]:
    """What, which, unit, value, command; those that are known."""
    found = []
    for name, where, keys in _every():
        for reading in results.readings(where):
            for key, unit, scale in keys:
                value = reading.values.get(key)
                if isinstance(value, int | float):
                    found.append((name, key, unit, scale * value, reading.command))
    return found


def rehearsal_table(results: Results) -> PageTable:
    """For the study's page."""
    rows: Sequence[TableRow] = [
        TableRow((name, _in_words(key), unit), (short(value),), (command,))
        for name, key, unit, value, command in _numbers(results)
    ]
    return PageTable(
        slug="table",
        title="All numbers",
        caption="Recorded runs are those of a scripted expert, some with a grasp and some without, "
        "through the arm's protocol and a rendered camera. The block's position is that of the "
        "recorded run against the simulation's; predictions are over 0.5 s with contacts measured "
        "(no arm has that), by the model alone (unmeasured), and corrected by the motion seen "
        "(inferred). Frozen contact is the error of true masses and the contact of each window's "
        "first step.",
        heads=_HEADS,
        rows=rows,
    )


def rehearsal_csv(results: Results) -> str:
    """For programs."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_HEADS, "command"])
    writer.writerows(_numbers(results))
    return text.getvalue()


def _in_words(key: str) -> str:
    for end in ("_m_s", "_m", "_s", "_hz"):
        if key.endswith(end):
            key = key.removesuffix(end)
            break
    return key.replace("_", " ")
