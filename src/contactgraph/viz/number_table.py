"""Numbers as a table: Markdown for people, CSV for programs."""

import csv
import io
import math
from collections.abc import Sequence

from contactgraph.viz import Number
from contactgraph_studies.words import short, with_unit


def markdown_numbers(numbers: Sequence[Number]) -> str:
    """A row a number: value and interval beside what is asked."""
    lines = [
        "| what | measured (interval or range over seeds) | at least | aim | reached |",
        "|---|---|---|---|---|",
    ]
    for number in numbers:
        value = math.nan if number.value is None else number.value
        measured = with_unit(value, number.unit)
        if number.interval is not None:
            low, high = number.interval
            measured += f" ({short(low)} to {short(high)})"
        reached = {None: "", True: "yes", False: "**no**"}[number.reached]
        asked = "" if number.at_least is None else short(number.at_least)
        aim = "" if number.aim is None else short(number.aim)
        lines.append(f"| {number.name} | {measured} | {asked} | {aim} | {reached} |")
    return "\n".join(lines) + "\n"


def csv_numbers(numbers: Sequence[Number]) -> str:
    """A row a number: name, unit, value, interval, what is asked, whether reached, command."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["what", "unit", "value", "low", "high", "at_least", "aim", "reached", "command"]
    )
    for number in numbers:
        low, high = number.interval or (None, None)
        row = [number.name, number.unit, number.value, low, high, number.at_least, number.aim]
        writer.writerow([*row, number.reached, number.command])
    return text.getvalue()
