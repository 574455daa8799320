"""Tables of numbers: Markdown for people, CSV for programs."""

import csv
import io
import math
from collections.abc import Sequence

from contactgraph.viz.report_data import Number


def markdown_numbers(numbers: Sequence[Number]) -> str:
    """One row per number: value, interval and target."""
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
    """One row per number: name, unit, value, interval, target, whether reached, command."""
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


def short(value: float) -> str:
    """Three significant digits, without an exponent if it stays readable."""
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "not finite"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2g}"
    if abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:.3g}"


def with_unit(value: float, unit: str) -> str:
    """As `short`, with the unit after a number."""
    return f"{short(value)} {unit}".strip() if math.isfinite(value) else short(value)
