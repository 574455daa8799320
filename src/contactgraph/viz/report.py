"""The report page: one HTML file that opens from disk and loads nothing."""

import base64
import hashlib
import itertools
import json
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from contactgraph.data import InvalidInputError, atomic_write
from contactgraph.viz.edge_beliefs import EDGE_STATES, BeliefTimeline
from contactgraph.viz.markup import (
    beliefs_table,
    errors_table,
    footer,
    metrics_table,
    reliability_table,
    tiles,
)
from contactgraph.viz.report_data import ReportData
from contactgraph.viz.scene_payload import floats, number, scene_payload

SCENE_SCRIPTS = (
    "data.js",
    "svg.js",
    "clock.js",
    "projection.js",
    "canvas.js",
    "scene_frame.js",
    "scene_bodies.js",
    "scene_paths.js",
    "scene_edges.js",
    "scene.js",
    "scene_turn.js",
)
"""Draw a scene; ordered by dependency, as those that follow."""
_SCRIPTS = (
    *SCENE_SCRIPTS,
    "time_plots.js",
    "time_panels.js",
    "belief_chart.js",
    "error_chart.js",
    "reliability_chart.js",
    "loss_chart.js",
    "page.js",
)


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the page atomically; missing folders are created.

    Raises `InvalidInputError` where ``path`` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InvalidInputError(f"report: {path} is a folder; name a file such as index.html in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(page(data), encoding="utf-8")


def page(data: ReportData) -> str:
    """The whole page as text."""
    script = one_scope(*(asset(name) for name in _SCRIPTS))
    return Template(asset("page.html")).substitute(
        title=escape(data.title),
        summary=escape(data.summary),
        script_hash=script_hash(script),
        style=asset("page.css"),
        tiles=tiles(data.metrics),
        scene=asset("scene.html") if data.scenes else "",
        beliefs=_section("beliefs.html", bool(data.beliefs), beliefs_table(data)),
        errors=_section("errors.html", bool(data.errors), errors_table(data.errors)),
        reliability=_section(
            "reliability.html", bool(data.reliability), reliability_table(data.reliability)
        ),
        losses=_section("losses.html", bool(data.losses), ""),
        numbers=_section("numbers.html", bool(data.metrics), metrics_table(data.metrics)),
        footer=footer(data),
        data=embedded_json(data),
        script=script,
    )


def _section(name: str, wanted: bool, content: str) -> str:
    return Template(asset(name)).substitute(content=content) if wanted else ""


def one_scope(*scripts: str) -> str:
    """All scripts in one scope."""
    body = "\n".join(scripts)
    return f'"use strict";\n(() => {{\n{body}\n}})();\n'


def script_hash(script: str) -> str:
    """The source by which a page's policy allows this script.

    The policy forbids every load and allows only this script, so that even a name which slipped
    through unescaped could not.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return f"sha256-{digest}"


def asset(name: str) -> str:
    """The text of a file of the page."""
    return (files("contactgraph.viz") / "assets" / name).read_text(encoding="utf-8")


def embedded_json(data: ReportData) -> str:
    """The page's data. ``<``, ``>`` and ``&`` are escaped, so no text in it can end a script."""
    payload = {
        "scenes": [scene_payload(scene) for scene in data.scenes],
        "beliefs": [_timeline(timeline) for timeline in data.beliefs],
        "horizon": number(data.horizon_s),
        "errors": [
            {
                "condition": error.condition,
                "windows": error.windows,
                "model": number(error.model_m),
                "frozenContact": number(error.frozen_contact_m),
                "constantVelocity": number(error.constant_velocity_m),
                "standingStill": number(error.standing_still_m),
                "interval": _pair(error.model_interval_m),
            }
            for error in data.errors
        ],
        "reliability": [
            {
                "panel": curve.panel,
                "source": curve.source,
                "bins": [
                    [count, number(belief), number(share)] for count, belief, share in curve.bins
                ],
                "error": number(curve.error),
            }
            for curve in data.reliability
        ],
        "losses": [
            {
                "name": loss.name,
                "heldOut": loss.held_out,
                "step": floats(loss.step),
                "value": floats(loss.value),
            }
            for loss in data.losses
        ],
    }
    text = json.dumps(payload, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _timeline(timeline: BeliefTimeline) -> dict[str, object]:
    return {
        "title": f"{timeline.name}: {timeline.edge}",
        "caption": timeline.caption,
        "dt": timeline.dt,
        "label": timeline.label_name,
        "truth": _state_runs(timeline.truth),
        "lines": [
            {
                "source": source,
                "belief": floats(belief),
                "states": _state_runs(timeline.state[source]),
            }
            for source, belief in timeline.belief.items()
        ],
    }


def _state_runs(states: np.ndarray) -> list[list[object]]:
    """Intervals of steps in which a state ``states`` [T] lasts, ``[name, first, last + 1]``."""
    bounds = [0, *(np.flatnonzero(np.diff(states)) + 1).tolist(), len(states)]
    return [[EDGE_STATES[states[first]], first, end] for first, end in itertools.pairwise(bounds)]


def _pair(values: tuple[float, float] | None) -> list[float | None] | None:
    return None if values is None else [number(value) for value in values]
