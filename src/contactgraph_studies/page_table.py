"""A table as it stands on a study's page, and in Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True)
class TableRow:
    """Texts of one row."""

    names: tuple[str, ...]
    """What it is of."""
    figures: tuple[str, ...]
    commands: tuple[str, ...] = ()
    """That made it; shown when the pointer rests on the row."""


@dataclass(frozen=True)
class PageTable:
    """A table with its section."""

    slug: str
    """Names the section."""
    title: str
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[TableRow]


def table_section(table: PageTable) -> str:
    """As HTML."""
    head = "".join(f"<th>{escape(name)}</th>" for name in table.heads)
    body = "".join(_row(row) for row in table.rows)
    return (
        f'<section id="{escape(table.slug)}"><h2>{escape(table.title)}</h2>\n'
        f'<p class="caption text">{escape(table.caption)}</p>\n'
        f'<div class="wide"><table class="plain"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>\n</section>\n"
    )


def _row(row: TableRow) -> str:
    title = escape("\n".join(row.commands))
    names = "".join(f"<td>{escape(name)}</td>" for name in row.names)
    figures = "".join(f'<td class="figure">{escape(cell)}</td>' for cell in row.figures)
    return f'<tr title="{title}">{names}{figures}</tr>'


def markdown_table(heads: Sequence[str], rows: Sequence[TableRow]) -> str:
    """As Markdown."""
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    lines += [f"| {' | '.join((*row.names, *row.figures))} |" for row in rows]
    return "\n".join(lines) + "\n"
