"""Tables of metrics: Markdown for people, CSV for programs."""

import csv
import io
import math
from collections.abc import Sequence

from contactgraph.viz.report_data import ReportMetric


def markdown_metrics(metrics: Sequence[ReportMetric]) -> str:
    """One row per metric: value, interval and target."""
    lines = [
        "| what | measured (interval or range over seeds) | at least | aim | reached |",
        "|---|---|---|---|---|",
    ]
    for metric in metrics:
        value = math.nan if metric.value is None else metric.value
        measured = with_unit(value, metric.unit)
        if metric.interval is not None:
            low, high = metric.interval
            measured += f" ({short(low)} to {short(high)})"
        reached = {None: "", True: "yes", False: "**no**"}[metric.reached]
        asked = "" if metric.at_least is None else short(metric.at_least)
        aim = "" if metric.aim is None else short(metric.aim)
        lines.append(f"| {metric.name} | {measured} | {asked} | {aim} | {reached} |")
    return "\n".join(lines) + "\n"


def csv_metrics(metrics: Sequence[ReportMetric]) -> str:
    """One row per metric: name, unit, value, interval, target, whether reached, command."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["what", "unit", "value", "low", "high", "at_least", "aim", "reached", "command"]
    )
    for metric in metrics:
        low, high = metric.interval or (None, None)
        row = [metric.name, metric.unit, metric.value, low, high, metric.at_least, metric.aim]
        writer.writerow([*row, metric.reached, metric.command])
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
