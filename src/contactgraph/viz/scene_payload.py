"""A scene as the page's scripts read it: names, shapes and arrays, ready for JSON."""

import base64
import math

import numpy as np

from contactgraph.viz.scene_trajectory import SceneTrajectory
from contactgraph.viz.selection import (
    focus_nodes,
    grasp_step,
    ground_of,
    involved_nodes,
    leading_edges,
    shown_directions,
)

_PLAN_MOVES = 0.005
"""m: plans of bodies that move less than this are not drawn."""
_PLAN_POINTS = 20
"""Approximate number of drawn points per plan, at most twice as many."""


def scene_payload(scene: SceneTrajectory) -> dict[str, object]:
    """All of a scene; arrays are `floats`."""
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
        "radius": [number(radius) for radius in scene.radius],
        "anchor": _rows(static.anchor),
        "planes": static.planes.tolist() if scene.dimension == 2 else None,
        "outlines": _outlines(scene),
        "orientation": floats(scene.trajectory.orientation) if _outlines(scene) else None,
        "box": _rows(static.size),
        "goal": None if scene.goal is None else [number(value) for value in scene.goal],
        "goalRadius": number(scene.goal_radius),
        "edges": scene.edges.tolist(),
        "position": floats(scene.position),
        "velocity": floats(scene.trajectory.velocity),
        "linkPoints": 0 if scene.link_positions is None else scene.link_positions.shape[1],
        "linkPositions": floats(scene.link_positions),
        "control": floats(scene.trajectory.control),
        "belief": floats(scene.belief),
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
    return None if values is None else [floats(each) for each in shown_directions(values)]


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
        "position": floats(shown),
    }


def _spans(active: np.ndarray) -> list[list[int]]:
    """Intervals of states in which ``active`` [T+1] holds, as ``[first, last + 1]``."""
    padded = np.concatenate([[False], active, [False]]).astype(np.int8)
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    return [[int(a), int(b)] for a, b in zip(starts, ends, strict=True)]


def floats(values: np.ndarray | None) -> str | None:
    """An array as the text that the scripts decode: 32-bit floats in base64."""
    if values is None:
        return None
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def number(value: float | None) -> float | None:
    """Seven digits; None for missing or non-finite values, which JSON lacks."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.7g}")
