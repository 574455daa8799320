"""The figures as a table: Markdown for people, CSV for programs."""

import csv
import io
from collections.abc import Sequence

from contactgraph.reproduce.figures import Figure


def markdown_table(figures: Sequence[Figure]) -> str:
    """A row a figure: median and range over training seeds beside what is asked."""
    lines = [
        "| what | measured, median (range over seeds) | at least | aim | reached |",
        "|---|---|---|---|---|",
    ]
    for figure in figures:
        measured = f"{_text(figure.median)} {figure.unit}".strip()
        if len(figure.values) > 1:
            measured += f" ({_text(min(figure.values))} to {_text(max(figure.values))})"
        reached = {None: "", True: "yes", False: "**no**"}[figure.reached]
        asked = "" if figure.at_least is None else _text(figure.at_least)
        aim = "" if figure.aim is None else _text(figure.aim)
        lines.append(f"| {figure.name} | {measured} | {asked} | {aim} | {reached} |")
    return "\n".join(lines) + "\n"


def csv_table(figures: Sequence[Figure]) -> str:
    """A row a figure and training seed's place: name, unit, seed's index, value, asked, command."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["what", "unit", "training", "value", "at_least", "aim", "command"])
    for figure in figures:
        for index, value in enumerate(figure.values):
            row = [figure.name, figure.unit, index, value, figure.at_least, figure.aim]
            writer.writerow([*row, figure.command])
    return text.getvalue()


def _text(value: float) -> str:
    return f"{value:.3g}"
