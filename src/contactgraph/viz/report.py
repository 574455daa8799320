"""The report page: one HTML file that opens from disk and loads nothing."""

import base64
import hashlib
import os
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from contactgraph.data import InvalidInputError
from contactgraph.viz.embed import embedded_json
from contactgraph.viz.markup import errors_table, footer, numbers_table, tiles
from contactgraph.viz.report_data import ReportData

_SCRIPTS = (
    "data.js",
    "svg.js",
    "clock.js",
    "projection.js",
    "canvas.js",
    "scene_frame.js",
    "scene_bodies.js",
    "scene_ways.js",
    "scene_edges.js",
    "scene.js",
    "scene_turn.js",
    "time_plots.js",
    "time_panels.js",
    "error_chart.js",
    "loss_chart.js",
    "page.js",
)
"""In the order in which they need each other."""


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the page, whole or not at all; folders on the way are made.

    Raises `InvalidInputError` where ``path`` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InvalidInputError(f"report: {path} is a folder; name a file such as index.html in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    unfinished.write_text(page(data), encoding="utf-8")
    unfinished.replace(path)


def page(data: ReportData) -> str:
    """The whole page as text."""
    script = _script()
    # The policy forbids every load; only this very script may run, so that even a name which
    # slipped through unescaped could not.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return Template(_asset("page.html")).substitute(
        title=escape(data.title),
        summary=escape(data.summary),
        script_hash=f"sha256-{digest}",
        style=_asset("page.css"),
        tiles=tiles(data.numbers),
        scene=_asset("scene.html") if data.runs else "",
        errors=_section("errors.html", bool(data.errors), errors_table(data.errors)),
        losses=_section("losses.html", bool(data.losses), ""),
        numbers=_section("numbers.html", bool(data.numbers), numbers_table(data.numbers)),
        footer=footer(data),
        data=embedded_json(data),
        script=script,
    )


def _section(name: str, wanted: bool, content: str) -> str:
    return Template(_asset(name)).substitute(content=content) if wanted else ""


def _script() -> str:
    """All scripts in one scope of their own."""
    body = "\n".join(_asset(name) for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{body}\n}})();\n'


def _asset(name: str) -> str:
    return (files("contactgraph.viz") / "assets" / name).read_text(encoding="utf-8")
