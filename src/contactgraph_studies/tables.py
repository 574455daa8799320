"""Tables of a study: one data frame, written as CSV, Markdown and HTML."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from contactgraph.data import InvalidInputError
from contactgraph_studies.results import Quantity, Results, SeedStatistic, Success, with_range

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


@dataclass(frozen=True)
class Row:
    """A row of a table: its labels, and the conditions whose numbers it shows, by name."""

    labels: Mapping[str, Any]
    results: Results = field(default_factory=lambda: Results({}))
    conditions: Mapping[str, Any] = field(default_factory=dict)

    def statistic(self, name: str, quantity: Quantity) -> SeedStatistic:
        """A number of a condition."""
        return self.results.statistic(self.conditions.get(name), quantity)

    def success(self, name: str) -> Success | None:
        """The pooled success of a condition."""
        return self.results.success(self.conditions.get(name))


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    name: str
    """Heading in ``table.csv``; "": only on the page. A statistic takes three columns there."""
    heading: str
    """Heading on the page and in ``table.md``; "": only in ``table.csv``."""
    value: Callable[[Row], Any]
    """Text, number, `SeedStatistic`, or None for an empty cell."""
    text: Callable[[Any], str] = cell_text
    """A value as the page shows it."""
    is_label: bool = False


def label(name: str, heading: str = "", is_label: bool = True) -> Column:
    """An entry of `Row.labels`."""
    return Column(name, heading, lambda row: row.labels[name], is_label=is_label)


def statistic(
    name: str,
    heading: str,
    condition: str,
    quantity: Quantity,
    text: Callable[[Any], str] = cell_text,
) -> Column:
    """A number of a condition."""
    return Column(name, heading, lambda row: row.statistic(condition, quantity), text)


def counts(condition: str, suffix: str = "") -> list[Column]:
    """Successes and episodes of a condition, in ``table.csv``."""

    def count(field: str) -> Column:
        name = f"{field}{suffix}"
        return Column(name, "", lambda row: getattr(row.success(condition), field, None))

    return [count("successes"), count("episodes")]


def success(heading: str, condition: str, text: Callable[[Any], str] = cell_text) -> Column:
    """The pooled success of a condition, on the page."""
    return Column("", heading, lambda row: row.success(condition), text)


def command(name: str, condition: str, quantity: Quantity) -> Column:
    """The command behind a number; on the page a tooltip of the row."""
    return Column(name, "", lambda row: row.statistic(condition, quantity).command)


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
    separator: str
    """Between the name of a statistic and median, low or high in ``table.csv``."""

    @classmethod
    def of(
        cls,
        slug: str,
        title: str,
        caption: str,
        columns: Sequence[Column],
        rows: Iterable[Row],
        separator: str = "_",
    ) -> "StudyTable":
        """The values of all columns in every row."""
        values = [[column.value(row) for column in columns] for row in rows]
        frame = pd.DataFrame(values, columns=range(len(columns)), dtype=object)
        return cls(slug, title, caption, columns, frame, separator)

    def csv(self) -> str:
        """The columns with a name; median, lowest and highest value of each statistic."""
        named = [(column.name, self.frame[at]) for at, column in enumerate(self.columns)]
        parts = [_csv_columns(name, cells, self.separator) for name, cells in named if name]
        return pd.concat(parts, axis=1).to_csv(index=False, lineterminator="\n")

    def texts(self) -> list[list[str]]:
        """The columns with a heading as a reader sees them; the headings first."""
        shown = [(at, column) for at, column in enumerate(self.columns) if column.heading]
        rows = [
            [column.text(row[at]) for at, column in shown]
            for row in self.frame.itertuples(index=False)
        ]
        return [[column.heading for _, column in shown], *rows]

    def markdown(self) -> str:
        """The columns with a heading."""
        heads, *rows = (f"| {' | '.join(cells)} |\n" for cells in self.texts())
        return "".join([heads, f"|{'---|' * (heads.count(' | ') + 1)}\n", *rows])

    def html(self) -> str:
        """The columns with a heading, as a section of a page; commands show as tooltips."""
        shown = [column for column in self.columns if column.heading]
        tags = ["<td>" if one.is_label else '<td class="figure">' for one in shown]
        commands = [at for at, one in enumerate(self.columns) if one.name.startswith("command")]
        heads, *rows = self.texts()
        lines = []
        for texts, values in zip(rows, self.frame.itertuples(index=False), strict=True):
            cells = (f"{tag}{escape(text)}</td>" for tag, text in zip(tags, texts, strict=True))
            tooltip = escape("\n".join(values[at] for at in commands))
            lines.append(f'<tr title="{tooltip}">{"".join(cells)}</tr>')
        return (
            f'<section id="{escape(self.slug)}"><h2>{escape(self.title)}</h2>\n'
            f'<p class="caption text">{escape(self.caption)}</p>\n<div class="wide">'
            f'<table class="plain"><thead><tr>{"".join(f"<th>{escape(h)}</th>" for h in heads)}'
            f"</tr></thead><tbody>{''.join(lines)}</tbody></table></div>\n</section>\n"
        )


def _csv_columns(name: str, cells: pd.Series, separator: str) -> pd.DataFrame:
    if not any(isinstance(value, SeedStatistic) for value in cells):
        return cells.to_frame(name)
    ends = ("median", "low", "high")
    return pd.DataFrame(
        {f"{name}{separator}{end}": [getattr(value, end) for value in cells] for end in ends}
    )
