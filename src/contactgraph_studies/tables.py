"""Tables of a study: one data frame, written as CSV, Markdown and HTML."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph.viz.number_table import short
from contactgraph_studies.results import SeedStatistic, with_range

try:
    import pandas as pd
except ImportError as error:
    raise InvalidInputError(
        "reproduce needs pandas: pip install 'contactgraph[studies]'"
    ) from error


def cell_text(value: Any) -> str:
    """Median with range of a statistic; any other value as text, None as nothing."""
    if isinstance(value, SeedStatistic):
        return with_range(value)
    return "" if value is None else str(value)


def known_text(value: SeedStatistic) -> str:
    """Median with range; nothing where no value is known."""
    return with_range(value) if value.known else ""


def median_text(value: SeedStatistic) -> str:
    """The median alone."""
    return short(value.median)


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    value: Callable[[Any], Any]
    """Of a row's condition: text, number, `SeedStatistic`, or None for an empty cell."""
    name: str = ""
    """Heading in ``table.csv``; "": only on the page. A statistic takes three columns there."""
    heading: str = ""
    """Heading on the page; "": only in ``table.csv``."""
    markdown: str = ""
    """Heading in ``table.md`` if it differs."""
    text: Callable[[Any], str] = cell_text
    """A value as the page shows it."""
    label: bool = False
    """Whether the column describes the condition."""


@dataclass(frozen=True, eq=False)
class StudyTable:
    """A table with its heading and caption."""

    slug: str
    """Anchor on the page."""
    title: str
    caption: str
    columns: Sequence[Column]
    frame: pd.DataFrame
    """One row for each condition, one column for each of ``columns``."""
    commands: Sequence[Sequence[str]]
    """The commands behind each row."""

    @classmethod
    def measure(
        cls,
        slug: str,
        title: str,
        caption: str,
        columns: Sequence[Column],
        conditions: Iterable[Any],
        commands: Callable[[Any], Sequence[str]] = lambda condition: (),
    ) -> "StudyTable":
        """The values of all columns under every condition."""
        rows = list(conditions)
        values = [[column.value(row) for column in columns] for row in rows]
        frame = pd.DataFrame(values, columns=range(len(columns)), dtype=object)
        return cls(slug, title, caption, columns, frame, [commands(row) for row in rows])

    def csv(self, separator: str = "_") -> str:
        """The columns with a name; median, lowest and highest value of each statistic."""
        named = [(column.name, self.frame[at]) for at, column in enumerate(self.columns)]
        parts = [_csv_columns(name, cells, separator) for name, cells in named if name]
        return pd.concat(parts, axis=1).to_csv(index=False, lineterminator="\n")

    def markdown(self) -> str:
        """The columns with a heading."""
        heads = [column.markdown or column.heading for column in self.columns if column.heading]
        lines = [f"| {' | '.join(cells)} |\n" for cells in (heads, *self.texts())]
        return "".join([lines[0], f"|{'---|' * len(heads)}\n", *lines[1:]])

    def html(self) -> str:
        """The columns with a heading, as a section of a page."""
        shown = [column for column in self.columns if column.heading]
        tags = ["<td>" if column.label else '<td class="figure">' for column in shown]
        head = "".join(f"<th>{escape(column.heading)}</th>" for column in shown)
        rows = []
        for texts, commands in zip(self.texts(), self.commands, strict=True):
            cells = (f"{tag}{escape(text)}</td>" for tag, text in zip(tags, texts, strict=True))
            rows.append(f'<tr title="{escape(chr(10).join(commands))}">{"".join(cells)}</tr>')
        return (
            f'<section id="{escape(self.slug)}"><h2>{escape(self.title)}</h2>\n'
            f'<p class="caption text">{escape(self.caption)}</p>\n'
            f'<div class="wide"><table class="plain"><thead><tr>{head}</tr></thead>'
            f"<tbody>{''.join(rows)}</tbody></table></div>\n</section>\n"
        )

    def texts(self) -> list[list[str]]:
        """The cells of every row as a reader sees them."""
        shown = [(at, column.text) for at, column in enumerate(self.columns) if column.heading]
        return [[text(row[at]) for at, text in shown] for row in self.frame.itertuples(index=False)]


def _csv_columns(name: str, cells: pd.Series, separator: str) -> pd.DataFrame:
    if not any(isinstance(value, SeedStatistic) for value in cells):
        return cells.to_frame(name)
    ends = ("median", "low", "high")
    return pd.DataFrame(
        {f"{name}{separator}{end}": [getattr(value, end) for value in cells] for end in ends}
    )
