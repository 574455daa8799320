"""The messages to a page: a scene when it changes, and a frame for every step."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from contactgraph.data import Scene, Trajectory, pair_indices
from contactgraph.envs.contract import Observation
from contactgraph.evaluate import Calibration, EpisodeRecord
from contactgraph.viz import SceneTrajectory
from contactgraph.viz.scene_payload import scene_payload
from contactgraph.viz.selection import shown_directions

_GHOSTS = 20
"""Approximate number of positions of a plan that are sent, at most twice as many."""
_DIGITS = 5
"""Of lengths, m; and of probabilities."""


def scene_of(
    scene: Scene, name: str, observation: Observation, control_size: int, links: np.ndarray | None
) -> SceneTrajectory:
    """A scene at rest as ``observation`` shows it, for the renderer of reports."""

    def twice(value: np.ndarray | None) -> np.ndarray | None:
        return None if value is None else np.stack([value, value])

    trajectory = Trajectory(
        scene=scene,
        position=np.stack([observation["position"]] * 2),
        velocity=np.stack([observation["velocity"]] * 2),
        control=np.zeros((1, control_size)),
        contact=np.stack([observation["contact"]] * 2).astype(bool),
        link_positions=twice(links),
        orientation=twice(observation.get("orientation")),
    )
    edges = pair_indices(scene.node_count)
    return SceneTrajectory(name, trajectory, edges, np.zeros((1, len(edges))))


def scene_message(
    drawn: SceneTrajectory, number: int, chain: Sequence[int], about: dict[str, Any]
) -> str:
    """Of a new scene. ``chain``: the task's nodes; ``about``: what else the page tells."""
    focus = [int(node) for node in chain]
    shown = {**scene_payload(drawn), "involved": focus, "focus": focus[:2]}
    return _json({"type": "scene", "number": number, "scene": shown, **about})


def motion(
    observation: Observation,
    control: np.ndarray,
    record: EpisodeRecord,
    inverse_mass: np.ndarray | None,
    links: np.ndarray | None,
    labels: np.ndarray,
) -> dict[str, Any]:
    """A frame's part about one step: the state before it, its control, its plan and beliefs."""
    plan = record.plan[0, :: max(1, (record.plan.shape[1] - 1) // _GHOSTS)]
    moved = np.nan_to_num(np.abs(plan - plan[:1])).max(axis=(0, 2)) > 0.005
    nodes = np.flatnonzero(moved)
    return {
        "position": _rounded(observation["position"]),
        "orientation": None
        if "orientation" not in observation or observation["orientation"].shape[1] != 1
        else _rounded(observation["orientation"]),
        "links": None if links is None else _rounded(links),
        "control": _rounded(control),
        "belief": _rounded(record.estimated[0]),
        "contact": np.flatnonzero(labels).tolist(),
        "plan": {
            "nodes": nodes.tolist(),
            "horizon": len(plan) - 1,
            "position": _rounded(plan[:, nodes]),
        },
        "inverseMass": None
        if inverse_mass is None
        else [_rounded(each) for each in shown_directions(inverse_mass)],
        "stepMs": round(float(record.plan_ms[0]), 3),
    }


def frame_message(values: dict[str, Any]) -> str:
    """A frame; missing numbers become null."""
    return _json({"type": "frame", **values})


def reliability(calibration: Calibration) -> dict[str, Any] | None:
    """As a curve of the report's chart; None before any belief was counted."""
    rows = calibration.reliability
    if rows is None:
        return None
    bins = [row for row in rows if row[0]]
    return {"source": "this session", "bins": bins, "error": calibration.expected_error}


def goal_distance(scene: Scene, observation: Observation, node: int) -> float | None:
    """m; None without a goal."""
    if scene.goal is None:
        return None
    return float(np.linalg.norm(observation["position"][node] - scene.goal))


def with_notes(trajectory: Trajectory, notes: dict[str, int | str]) -> Trajectory:
    """The trajectory with ``notes`` in its scene's metadata."""
    scene = trajectory.scene
    return replace(trajectory, scene=replace(scene, metadata={**scene.metadata, **notes}))


def _rounded(values: np.ndarray) -> list[float | None]:
    flat = np.round(np.asarray(values, np.float64).ravel(), _DIGITS)
    return [value if np.isfinite(value) else None for value in flat.tolist()]


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False, separators=(",", ":"))
