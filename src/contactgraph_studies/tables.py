"""Tables of a study: one data frame each, written as CSV, Markdown and HTML."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.viz.metric_table import short
from contactgraph_studies.results import SeedStatistic, Success, with_range

try:
    import pandas as pd
except ImportError as error:
    message = "reproduce needs pandas: pip install 'contactgraph[studies]'"
    raise InvalidInputError(message) from error


def cell_text(value: Any) -> str:
    """Median with range of a statistic; any other value as text, None as nothing."""
    if isinstance(value, SeedStatistic):
        return with_range(value)
    return "" if value is None else str(value)


def known_text(value: SeedStatistic) -> str:
    """Median with range; nothing if no value is known."""
    return with_range(value) if value.known else ""


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

    slug: str
    """Anchor on the page."""
    title: str
    caption: str
    headings: Mapping[str, str]
    """The columns on the page and in ``table.md``: heading by name."""
    rows: Sequence[Mapping[str, Any]]
    """Texts, numbers, `SeedStatistic` or `Success` by name of the column.

    All are columns of ``table.csv``, a `SeedStatistic` three, but for names with an underscore.
    ``_bold`` of a row holds the names of its bold cells.
    """
    texts: Mapping[str, Callable[[Any], str]] = field(default_factory=dict)
    """Format on the page, by name of the column; `cell_text` for others."""
    separator: str = "_"
    """Between the name of a statistic and median, low or high in ``table.csv``."""
    notes: Sequence[str] = ()
    """Sentences below the table."""

    @property
    def frame(self) -> pd.DataFrame:
        """One row for each condition."""
        columns = list(self.rows[0] if self.rows else self.headings)
        return pd.DataFrame(self.rows, columns=columns, dtype=object)

    def csv(self) -> str:
        """The table for programs."""
        columns = [cells for name, cells in self.frame.items() if not name.startswith("_")]
        parts = [_csv_columns(cells, self.separator) for cells in columns]
        return pd.concat(parts, axis=1).to_csv(index=False, lineterminator="\n")

    def page_cells(self) -> pd.DataFrame:
        """The cells of the page as texts."""
        shown = self.frame[list(self.headings)]
        return shown.apply(lambda cells: cells.map(self.texts.get(cells.name, cell_text)))

    def markdown(self) -> str:
        """The cells of the page as Markdown."""
        lines = [_markdown_row(self.headings.values()), f"|{'---|' * len(self.headings)}"]
        for row, texts in self._shown_rows():
            bold = row.get("_bold", ())
            cells = (f"**{text}**" if name in bold else text for name, text in texts.items())
            lines.append(_markdown_row(cells))
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join([*lines, *notes, ""])

    def html(self) -> str:
        """The cells of the page as a section; a row's commands show as its tooltip."""
        heads = "".join(f"<th>{escape(head)}</th>" for head in self.headings.values())
        rows = []
        for row, texts in self._shown_rows():
            commands = [row[name] for name in row if name.startswith("command")]
            bold = row.get("_bold", ())
            cells = (_html_cell(row[name], text, name in bold) for name, text in texts.items())
            rows.append(f'<tr title="{escape(chr(10).join(commands))}">{"".join(cells)}</tr>')
        items = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        notes = f'<ul class="caption">{items}</ul>\n' if items else ""
        return (
            f'<section id="{escape(self.slug)}"><h2>{escape(self.title)}</h2>\n'
            f'<p class="caption text">{escape(self.caption)}</p>\n'
            f'<div class="wide"><table class="plain"><thead><tr>{heads}</tr></thead>'
            f"<tbody>{''.join(rows)}</tbody></table></div>\n{notes}</section>\n"
        )

    def _shown_rows(self) -> Iterable[tuple[Mapping[str, Any], dict[Any, str]]]:
        """Each row, and the texts of its cells on the page by name of the column."""
        return zip(self.rows, self.page_cells().to_dict("records"), strict=True)


def _markdown_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def counts(success: Success | None, suffix: str = "") -> dict[str, int | str | None]:
    """Successes and episodes of `Success.trials`, and each seed's rate, as columns of
    ``table.csv``."""
    values: list[int | str | None] = [None, None, None]
    if success is not None:
        each = " ".join(short(percent) for percent in success.each_percent)
        values = [*success.trials, each]
    names = ("successes", "episodes", "percent_of_each_seed")
    return {f"{name}{suffix}": value for name, value in zip(names, values, strict=True)}


def _csv_columns(cells: pd.Series, separator: str) -> pd.DataFrame:
    if not any(isinstance(value, SeedStatistic) for value in cells):
        return cells.to_frame()
    ends = ("median", "low", "high")
    return pd.DataFrame(
        {f"{cells.name}{separator}{end}": [getattr(one, end) for one in cells] for end in ends}
    )


def _html_cell(value: Any, text: str, bold: bool) -> str:
    is_number = isinstance(value, SeedStatistic | Success | float)
    tag = '<td class="figure">' if is_number else "<td>"
    return f"{tag}<b>{escape(text)}</b></td>" if bold else f"{tag}{escape(text)}</td>"
