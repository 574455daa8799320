"""The report page: one HTML file that opens from disk and loads nothing."""

import base64
import hashlib
import itertools
import json
import math
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
from contactgraph.viz.scene_trajectory import SceneTrajectory
from contactgraph.viz.selection import (
    focus_nodes,
    grasp_step,
    ground_of,
    involved_nodes,
    leading_edges,
    shown_directions,
)

_SCRIPTS = (
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
    "time_plots.js",
    "time_panels.js",
    "belief_chart.js",
    "error_chart.js",
    "reliability_chart.js",
    "loss_chart.js",
    "page.js",
)
"""Ordered by dependency."""


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
    script = _script()
    # The policy forbids every load and allows only this script, so that even a name which
    # slipped through unescaped could not.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return Template(_asset("page.html")).substitute(
        title=escape(data.title),
        summary=escape(data.summary),
        script_hash=f"sha256-{digest}",
        style=_asset("page.css"),
        tiles=tiles(data.metrics),
        scene=_asset("scene.html") if data.scenes else "",
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
    return Template(_asset(name)).substitute(content=content) if wanted else ""


def _script() -> str:
    """All scripts in one scope."""
    body = "\n".join(_asset(name) for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{body}\n}})();\n'


def _asset(name: str) -> str:
    return (files("contactgraph.viz") / "assets" / name).read_text(encoding="utf-8")


_PLAN_MOVES = 0.005
"""m: plans of bodies that move less than this are not drawn."""
_PLAN_POINTS = 20
"""Approximate number of drawn points per plan, at most twice as many."""


def embedded_json(data: ReportData) -> str:
    """The page's data. ``<``, ``>`` and ``&`` are escaped, so no text in it can end a script."""
    payload = {
        "scenes": [_scene(scene) for scene in data.scenes],
        "beliefs": [_timeline(timeline) for timeline in data.beliefs],
        "horizon": _number(data.horizon_s),
        "errors": [
            {
                "condition": error.condition,
                "windows": error.windows,
                "model": _number(error.model_m),
                "frozenContact": _number(error.frozen_contact_m),
                "constantVelocity": _number(error.constant_velocity_m),
                "standingStill": _number(error.standing_still_m),
                "interval": _pair(error.model_interval_m),
            }
            for error in data.errors
        ],
        "reliability": [
            {
                "panel": curve.panel,
                "source": curve.source,
                "bins": [
                    [count, _number(belief), _number(share)] for count, belief, share in curve.bins
                ],
                "error": _number(curve.error),
            }
            for curve in data.reliability
        ],
        "losses": [
            {
                "name": loss.name,
                "heldOut": loss.held_out,
                "step": _floats(loss.step),
                "value": _floats(loss.value),
            }
            for loss in data.losses
        ],
    }
    text = json.dumps(payload, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _scene(scene: SceneTrajectory) -> dict[str, object]:
    static = scene.trajectory.scene
    return {
        "name": scene.name,
        "dt": scene.dt,
        "steps": scene.steps,
        "dimension": scene.dimension,
        "axes": scene.projection.axes.tolist(),
        "ground": _ground(scene),
        "controlSize": scene.force_size,
        "nodeName": list(scene.node_name),
        "nodeType": list(static.node_type),
        "actuated": scene.actuated.tolist(),
        "radius": [_number(radius) for radius in scene.radius],
        "anchor": None if static.anchor is None else _rows(static.anchor),
        "planes": None if static.planes is None or scene.dimension != 2 else static.planes.tolist(),
        "outlines": _outlines(scene),
        "orientation": _floats(scene.trajectory.orientation) if _outlines(scene) else None,
        "box": [None] * scene.node_count if static.size is None else _rows(static.size),
        "goal": None if scene.goal is None else [_number(value) for value in scene.goal],
        "goalRadius": _number(scene.goal_radius),
        "edges": scene.edges.tolist(),
        "position": _floats(scene.position),
        "velocity": _floats(scene.trajectory.velocity),
        "linkPoints": 0 if scene.link_positions is None else scene.link_positions.shape[1],
        "linkPositions": _floats(scene.link_positions),
        "control": _floats(scene.trajectory.control),
        "belief": _floats(scene.belief),
        "contact": None if scene.contact is None else [_spans(each) for each in scene.contact.T],
        "inverseMass": _directions(scene.inverse_mass),
        "stiffness": _directions(scene.stiffness),
        "damping": _directions(scene.damping),
        "plan": _plan(scene),
        "leading": leading_edges(scene),
        "focus": focus_nodes(scene),
        "involved": involved_nodes(scene),
        "grasp": grasp_step(scene),
    }


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
                "belief": _floats(belief),
                "states": _state_runs(timeline.state[source]),
            }
            for source, belief in timeline.belief.items()
        ],
    }


def _state_runs(states: np.ndarray) -> list[list[object]]:
    """Intervals of steps in which a state ``states`` [T] lasts, ``[name, first, last + 1]``."""
    bounds = [0, *(np.flatnonzero(np.diff(states)) + 1).tolist(), len(states)]
    return [[EDGE_STATES[states[first]], first, end] for first, end in itertools.pairwise(bounds)]


def _rows(values: np.ndarray) -> list[list[float] | None]:
    """The rows of numbers; None for one of NaN."""
    return [None if np.isnan(row).any() else row.tolist() for row in values]


def _outlines(scene: SceneTrajectory) -> list[list[list[list[float]]]] | None:
    """The polygons of each node in the plane; None where no node has one."""
    static = scene.trajectory.scene
    nodes = range(scene.node_count) if static.polygons and scene.dimension == 2 else ()
    return [[each.tolist() for each in static.outlines_of(node)] for node in nodes] or None


def _ground(scene: SceneTrajectory) -> dict[str, object] | None:
    ground = ground_of(scene)
    return (
        None
        if ground is None
        else {
            "low": ground.low.tolist(),
            "high": ground.high.tolist(),
            "level": ground.level,
            "spacing": ground.spacing,
        }
    )


def _directions(values: np.ndarray | None) -> list[str | None] | None:
    return None if values is None else [_floats(each) for each in shown_directions(values)]


def _plan(scene: SceneTrajectory) -> dict[str, object] | None:
    """Plans of moving bodies; resting distractors would be most of the page."""
    if scene.plan is None or scene.plan.shape[1] < 2:
        return None
    moved = np.nan_to_num(np.abs(scene.plan - scene.plan[:, :1])).max(axis=(0, 1, 3))
    nodes = np.flatnonzero(moved > _PLAN_MOVES)
    shown = scene.plan[:, :: max(1, (scene.plan.shape[1] - 1) // _PLAN_POINTS), nodes]
    return {
        "nodes": nodes.tolist(),
        "horizon": shown.shape[1] - 1,
        "position": _floats(shown),
    }


def _spans(active: np.ndarray) -> list[list[int]]:
    """Intervals of states in which ``active`` [T+1] holds, as ``[first, last + 1]``."""
    padded = np.concatenate([[False], active, [False]]).astype(np.int8)
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return [[int(a), int(b)] for a, b in zip(starts, ends, strict=True)]


def _floats(values: np.ndarray | None) -> str | None:
    if values is None:
        return None
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def _number(value: float | None) -> float | None:
    """Seven digits; None for missing or non-finite values, which JSON lacks."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.7g}")


def _pair(values: tuple[float, float] | None) -> list[float | None] | None:
    return None if values is None else [_number(value) for value in values]
