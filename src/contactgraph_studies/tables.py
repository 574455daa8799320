"""Tables of a study, as CSV and Markdown."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from contactgraph.viz.metric_table import short
from contactgraph_studies.results import SeedStatistic, Success, with_range


def cell_text(value: Any) -> str:
    """Median with range of a statistic; any other value as text, None as nothing."""
    if isinstance(value, SeedStatistic):
        return with_range(value)
    return "" if value is None else str(value)


DASH = "-"


def number_text(value: SeedStatistic) -> str:
    """The median, with a range if trainings differ as displayed; a dash if it is not known."""
    if not value.known:
        return DASH
    alike = short(value.low) == short(value.high)
    return short(value.median) if alike else with_range(value)


@dataclass(frozen=True)
class StudyTable:
    """A table with its heading and caption."""

    title: str
    caption: str
    headings: Mapping[str, str]
    """The columns of ``table.md``: heading by name."""
    rows: Sequence[Mapping[str, Any]]
    """Texts, numbers, `SeedStatistic` or `Success` by name of the column.

    All are columns of ``table.csv``, a `SeedStatistic` three, but for names with an underscore.
    ``_bold`` of a row holds the names of its bold cells.
    """
    texts: Mapping[str, Callable[[Any], str]] = field(default_factory=dict)
    """Format in ``table.md``, by name of the column; `cell_text` for others."""
    notes: Sequence[str] = ()
    """Sentences below the table."""

    def csv(self) -> str:
        """The table for programs."""
        rows = [dict(_csv_cells(row)) for row in self.rows]
        names = list(rows[0] if rows else self.headings)
        text = io.StringIO()
        writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()

    def texts_of(self, row: Mapping[str, Any]) -> list[str]:
        """The cells of a row of ``table.md``, without emphasis."""
        return [self.texts.get(name, cell_text)(row.get(name)) for name in self.headings]

    def markdown(self) -> str:
        """The table for people."""
        lines = [_markdown_row(self.headings.values()), f"|{'---|' * len(self.headings)}"]
        for row in self.rows:
            bold = [name in row.get("_bold", ()) for name in self.headings]
            cells = zip(self.texts_of(row), bold, strict=True)
            lines.append(_markdown_row(f"**{text}**" if strong else text for text, strong in cells))
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join([*lines, *notes, ""])


def _markdown_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def counts(success: Success | None, suffix: str = "") -> dict[str, int | str | None]:
    """Successes and episodes of `Success.trials`, and each seed's rate, as columns of
    ``table.csv``."""
    names = [f"{name}{suffix}" for name in ("successes", "episodes", "percent_of_each_seed")]
    if success is None:
        return dict.fromkeys(names)
    each = " ".join(short(percent) for percent in success.each_percent)
    return dict(zip(names, (*success.trials, each), strict=True))


def _csv_cells(row: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What is not known is left empty."""
    shown = {name: value for name, value in row.items() if not name.startswith("_")}
    for name, value in shown.items():
        if isinstance(value, SeedStatistic):
            for end in ("median", "low", "high"):
                number = getattr(value, end)
                yield f"{name}_{end}", "" if math.isnan(number) else number
        else:
            yield name, value
