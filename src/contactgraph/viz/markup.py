"""The parts of a report page that are plain HTML. All external text is escaped here."""

import math
from html import escape

from contactgraph.viz.metric_table import short
from contactgraph.viz.report_data import NStepError, ReliabilityCurve, ReportData, ReportMetric

_MISSING = "&ndash;"


def tiles(metrics: tuple[ReportMetric, ...]) -> str:
    """The figures shown large at the head of the page."""
    shown = [metric for metric in metrics if metric.tile]
    if not shown:
        return ""
    items = []
    for metric in shown:
        interval = _interval(metric)
        between = f'<span class="tile-interval">{escape(interval)}</span>'
        unit = f'<span class="tile-unit">{escape(metric.unit)}</span>' if metric.unit else ""
        items.append(
            f'<li><span class="tile-name">{escape(metric.name)}</span>'
            f'<span class="tile-value">{figure(metric.value)}{unit}</span>{between}</li>'
        )
    return f'<ul class="tiles" aria-label="Key numbers">{"".join(items)}</ul>'


def metrics_table(metrics: tuple[ReportMetric, ...]) -> str:
    """Every number with its command and its seed."""
    if not metrics:
        return ""
    heads = ("What", "Value", "95 % interval", "Command", "Seed")
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    rows = "".join(_row(metric) for metric in metrics)
    return f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'


def _row(metric: ReportMetric) -> str:
    command = f"<code>{escape(metric.command)}</code>" if metric.command else _MISSING
    cells = (
        ("Value", f"{figure(metric.value)} {escape(metric.unit)}".strip(), "figure"),
        ("95 % interval", escape(_interval(metric)) or _MISSING, "figure"),
        ("Command", command, "command"),
        ("Seed", _MISSING if metric.seed is None else str(metric.seed), "figure"),
    )
    body = "".join(f'<td class="{kind}" data-label="{name}">{v}</td>' for name, v, kind in cells)
    return f'<tr><th scope="row">{escape(metric.name)}</th>{body}</tr>'


def _interval(metric: ReportMetric) -> str:
    if metric.interval is None:
        return ""
    low, high = metric.interval
    return f"{figure(low)} to {figure(high)} {metric.unit}".strip()


def figure(value: float | None) -> str:
    """A number as `short` writes it, or a dash."""
    return _MISSING if value is None or not math.isfinite(value) else short(value)


def beliefs_table(data: ReportData) -> str:
    """The scores of all corrections of beliefs, of the tasks that have them; errors in cm."""
    rows = [
        f'<tr><td>{escape(timeline.name)}</td><th scope="row">{escape(source)}</th>'
        f'<td class="figure">{figure(f1)}</td><td class="figure">{_centimetres(error)}</td></tr>'
        for timeline in data.beliefs
        for source, (f1, error) in timeline.scores.items()
    ]
    if not rows:
        return ""
    ahead = "" if data.horizon_s is None else f" {short(data.horizon_s)} s"
    names = ("Task", "Corrected by", "F1 of all edges", f"Error{ahead} ahead, cm")
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    body = "".join(rows)
    return f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def errors_table(errors: tuple[NStepError, ...]) -> str:
    """The N-step errors as a table, an alternative to the chart; cm."""
    if not errors:
        return ""
    names = (
        "Windows",
        "Condition",
        "Model",
        "Frozen contact",
        "Constant velocity",
        "Standing still",
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    rows = []
    for error in errors:
        values = (
            error.model_m,
            error.frozen_contact_m,
            error.constant_velocity_m,
            error.standing_still_m,
        )
        cells = "".join(f'<td class="figure">{_centimetres(value)}</td>' for value in values)
        labels = f'<td>{escape(error.windows)}</td><th scope="row">{escape(error.condition)}</th>'
        rows.append(f"<tr>{labels}{cells}</tr>")
    return (
        "<details><summary>The same as figures (cm)</summary>"
        f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
        "</details>"
    )


def reliability_table(curves: tuple[ReliabilityCurve, ...]) -> str:
    """The expected calibration errors as a table, beside the chart."""
    if not curves:
        return ""
    names = ("Beliefs", "Corrected by", "Calibration error")
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    rows = "".join(
        f'<tr><td>{escape(curve.panel)}</td><th scope="row">{escape(curve.source)}</th>'
        f'<td class="figure">{figure(curve.error)}</td></tr>'
        for curve in curves
    )
    return f'<table class="plain"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'


def _centimetres(value: float | None) -> str:
    return figure(None if value is None else 100.0 * value)


def footer(data: ReportData) -> str:
    """The commands that reproduce the page, and the versions used."""
    parts = []
    if data.remake:
        lines = "\n".join(escape(line) for line in data.remake)
        parts.append(f"<p>To make this page again:</p><pre><code>{lines}</code></pre>")
    if data.versions:
        versions = (f"{escape(name)} {escape(each)}" for name, each in data.versions.items())
        parts.append(f"<p>{' · '.join(versions)}</p>")
    return "".join(parts)
