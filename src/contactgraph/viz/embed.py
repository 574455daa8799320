"""A report's data as JSON that is safe inside a page and small: arrays as base64 of float32."""

import base64
import json
import math

import numpy as np

from contactgraph.viz.ground import Ground, ground_of
from contactgraph.viz.report_data import ReportData
from contactgraph.viz.scene_run import SceneRun
from contactgraph.viz.selection import (
    focus_nodes,
    grasp_step,
    involved_nodes,
    leading_edges,
    shown_directions,
)

_PLAN_MOVES = 0.005
"""m: a body that no plan moves further than this is left out of the drawn plans."""
_PLAN_POINTS = 20
"""Points of a plan that are drawn, at most about twice as many; more would run into a line."""


def embedded_json(data: ReportData) -> str:
    """The page's data. ``<``, ``>`` and ``&`` are escaped, so no text in it can end a script."""
    payload = {
        "runs": [_run(run) for run in data.runs],
        "horizon": _number(data.horizon_s),
        "errors": [
            {
                "condition": error.condition,
                "windows": error.windows,
                "model": _number(error.model_m),
                "frozenContact": _number(error.frozen_contact_m),
                "constantVelocity": _number(error.constant_velocity_m),
                "interval": _pair(error.model_interval_m),
            }
            for error in data.errors
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


def _run(run: SceneRun) -> dict[str, object]:
    return {
        "name": run.name,
        "dt": run.dt,
        "steps": run.steps,
        "dimension": run.dimension,
        "axes": run.projection.axes.tolist(),
        "ground": _ground(ground_of(run)),
        "controlSize": run.control.shape[1],
        "nodeName": list(run.node_name),
        "nodeType": list(run.node_type),
        "actuated": run.actuated.tolist(),
        "radius": [_number(radius) for radius in run.radius],
        "anchor": _anchors(run),
        "box": [_list(run.box(node)) for node in range(run.node_count)],
        "goal": None if run.goal is None else [_number(value) for value in run.goal],
        "goalRadius": _number(run.goal_radius),
        "edges": run.edges.tolist(),
        "position": _floats(run.position),
        "velocity": _floats(run.velocity),
        "skeletonPoints": 0 if run.skeleton is None else run.skeleton.shape[1],
        "skeleton": _floats(run.skeleton),
        "control": _floats(run.control),
        "belief": _floats(run.belief),
        "contact": None if run.contact is None else [_spans(run.contact[:, e]) for e in _all(run)],
        "inverseMass": _directions(run.inverse_mass),
        "stiffness": _directions(run.stiffness),
        "damping": _directions(run.damping),
        "plan": _plan(run),
        "leading": leading_edges(run),
        "focus": focus_nodes(run),
        "involved": involved_nodes(run),
        "grasp": grasp_step(run),
    }


def _anchors(run: SceneRun) -> list[list[float] | None] | None:
    """[N] where each node's hinge is; None for a node without one."""
    if run.anchor is None:
        return None
    nodes = range(run.node_count)
    return [None if run.bar(n) is None else run.anchor[n].tolist() for n in nodes]


def _list(values: np.ndarray | None) -> list[float] | None:
    return None if values is None else values.tolist()


def _ground(ground: Ground | None) -> dict[str, object] | None:
    if ground is None:
        return None
    return {
        "low": ground.low.tolist(),
        "high": ground.high.tolist(),
        "level": ground.level,
        "spacing": ground.spacing,
    }


def _directions(values: np.ndarray | None) -> list[str | None] | None:
    return None if values is None else [_floats(each) for each in shown_directions(values)]


def _all(run: SceneRun) -> range:
    return range(run.edge_count)


def _plan(run: SceneRun) -> dict[str, object] | None:
    """Plans of the bodies that they move; resting bystanders would be most of the page."""
    if run.plan is None or run.plan.shape[1] < 2:
        return None
    moved = np.nan_to_num(np.abs(run.plan - run.plan[:, :1])).max(axis=(0, 1, 3))
    nodes = np.flatnonzero(moved > _PLAN_MOVES)
    shown = run.plan[:, :: max(1, (run.plan.shape[1] - 1) // _PLAN_POINTS), nodes]
    return {
        "nodes": nodes.tolist(),
        "horizon": shown.shape[1] - 1,
        "position": _floats(shown),
    }


def _spans(active: np.ndarray) -> list[list[int]]:
    """Where ``active`` [T+1] holds, as ``[first, one past the last]`` state numbers."""
    padded = np.concatenate([[False], active, [False]]).astype(np.int8)
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return [[int(a), int(b)] for a, b in zip(starts, ends, strict=True)]


def _floats(values: np.ndarray | None) -> str | None:
    if values is None:
        return None
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def _number(value: float | None) -> float | None:
    """Seven digits; None for what is missing or not finite, which JSON cannot say."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.7g}")


def _pair(values: tuple[float, float] | None) -> list[float | None] | None:
    return None if values is None else [_number(value) for value in values]
