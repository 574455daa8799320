"""Tables of metrics in Markdown."""

import math
from collections.abc import Sequence

from contactgraph.viz.report_data import ReportMetric


def markdown_metrics(metrics: Sequence[ReportMetric]) -> str:
    """One row per metric: value and interval."""
    lines = [
        "| what | measured (interval) |",
        "|---|---|",
    ]
    for metric in metrics:
        value = math.nan if metric.value is None else metric.value
        measured = with_unit(value, metric.unit)
        if metric.interval is not None:
            low, high = metric.interval
            measured += f" ({short(low)} to {short(high)})"
        lines.append(f"| {metric.name} | {measured} |")
    return "\n".join(lines) + "\n"


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
