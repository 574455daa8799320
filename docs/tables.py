"""Writes the tables of README.md and of pages of docs from the measured tables in results/tables.

Usage: python docs/tables.py [--check]

A table stands between two comments. The first names the CSV file, the rows by their first cells
(cells separated by " / ", rows by ";"), and the columns, each with its heading. A column of which
the file has median, low and high is shown as the median with its range. The smallest of the columns
named after "bold" is bold.
"""

import csv
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from contactgraph_studies.results import SeedStatistic, smallest
from contactgraph_studies.tables import DASH, number_text

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/results.md", "docs/inference.md")
TABLE = re.compile(
    r"<!-- table (?P<file>\S+)\nrows: (?P<rows>.+)\ncolumns: (?P<columns>.+)\n"
    r"(?:bold: (?P<bold>.+)\n)?-->\n(?P<body>(?:\|.*\n)*)<!-- end of table -->"
)


def cells_of(path: Path, key: str) -> Mapping[str, str]:
    """The row of a CSV file whose first cells are the key's."""
    first = [part.strip() for part in key.split(" / ")]
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if list(row.values())[: len(first)] == first:
                return row
    raise SystemExit(f"{path.name} has no row {key}")


def text_of(cells: Mapping[str, str], column: str) -> str:
    """The text of a cell of the page."""
    if f"{column}_median" not in cells:
        text = cells[column]
        if column == "row":
            return f"`{text}`"
        if column.startswith("percent_of_each_seed"):
            return ", ".join(text.split()) or DASH
        return text or DASH
    median, low, high = (cells[f"{column}_{end}"] for end in ("median", "low", "high"))
    if not median:
        return DASH
    return number_text(SeedStatistic((float(low), float(median), float(high))))


def table(found: re.Match[str]) -> str:
    """The lines of a table."""
    path = ROOT / "results" / "tables" / found["file"]
    columns = [part.split(" = ") for part in found["columns"].split("; ")]
    lines = [[heading for heading, _ in columns]]
    for key in found["rows"].split("; "):
        cells = cells_of(path, key)
        medians = {name: cells[f"{name}_median"] for name in (found["bold"] or "").split()}
        bold = smallest({name: float(text) for name, text in medians.items() if text})
        texts = ((name.strip(), text_of(cells, name.strip())) for _, name in columns)
        lines.append([f"**{text}**" if name in bold else text for name, text in texts])
    head, *body = (f"| {' | '.join(line)} |\n" for line in lines)
    return "".join((head, f"|{'---|' * len(columns)}\n", *body))


def with_tables(page: str) -> str:
    """The text of a page with the tables that the files have today."""

    def replaced(found: re.Match[str]) -> str:
        head = found[0][: found.start("body") - found.start()]
        return f"{head}{table(found)}<!-- end of table -->"

    return TABLE.sub(replaced, page)


def main() -> None:
    """Write the pages, or with --check name those that differ."""
    stale = []
    for name in PAGES:
        before = (ROOT / name).read_text(encoding="utf-8")
        after = with_tables(before)
        if before != after:
            stale.append(name)
            if "--check" not in sys.argv:
                (ROOT / name).write_text(after, encoding="utf-8")
    print("\n".join(stale))
    if stale and "--check" in sys.argv:
        sys.exit(1)


if __name__ == "__main__":
    main()
