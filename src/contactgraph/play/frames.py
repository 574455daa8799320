"""The messages to a page: a scene when it changes, and a frame for every step."""

import json
import time
from collections import deque
from typing import Any

import numpy as np

from contactgraph.data import Scene, Trajectory, pair_indices
from contactgraph.envs.contract import Observation
from contactgraph.evaluate import Calibration, Episode, belief_calibration
from contactgraph.evaluate.calibration import no_calibration
from contactgraph.play.stage import Stage
from contactgraph.policies import EpisodeRecord, switches_of
from contactgraph.viz import SceneTrajectory
from contactgraph.viz.scene_payload import number, scene_payload
from contactgraph.viz.selection import shown_directions

_GHOSTS = 20
"""Approximate number of positions of a plan that are sent, at most twice as many."""
_FRAMES_A_SECOND = 60.0
_EARLY = 0.002
"""s; a step is shown that comes so much earlier than a frame is due."""
_RECENT = 100
"""Steps over which the time of a control step is told."""
_DIGITS = 5
"""Of lengths, m; and of probabilities."""


class View:
    """The newest messages of a session, and what is told over several steps."""

    def __init__(self, before: "View | None" = None) -> None:
        """``before``: the view of a session so far, whose numbers of messages go on."""
        self.newest: tuple[str | None, str | None] = (None, None)
        """The newest message about the scene, and that about the motion in it."""
        self._scene: int = 0 if before is None else before._scene
        self._notices: int = 0 if before is None else before._notices
        self._notice: str | None = None
        self._motion: dict[str, Any] = {}
        self._plan_ms: deque[float] = deque(maxlen=_RECENT)
        self._calibration = no_calibration()
        self._goal_radius = 0.0
        self._last = 0.0

    def tell(self, text: str) -> None:
        """One line to be shown with the next frames."""
        self._notices, self._notice = self._notices + 1, text

    def begin(self, stage: Stage, episode: Episode, about: dict[str, Any]) -> None:
        """A new scene; ``about``: what else the page tells of it."""
        scene, choice, task = stage.task.scene, stage.choice, stage.task
        drawn = _scene_of(scene, choice.task, episode, np.shape(task.action_space.sample())[0])
        terms = task.cost_terms()
        chain = [*terms.chain, *(node for node in terms.candidates if node != terms.chain[-1])]
        message = {
            **about,
            "type": "scene",
            "number": self._scene + 1,
            "scene": {**scene_payload(drawn), "involved": chain, "focus": chain[:2]},
            "model": choice.model,
            "task": choice.task,
            "distractors": choice.distractors,
            "disturbable": stage.disturbable,
            "switches": bool(switches_of(scene)),
        }
        self._scene += 1
        self._goal_radius, self._motion, self._notice = drawn.goal_radius, {}, None
        self.newest = (_json(message), None)

    def step(
        self,
        stage: Stage,
        steps: int,
        observation: Observation,
        links: np.ndarray | None,
        control: np.ndarray,
        asked: int,
        alone: bool,
    ) -> bool:
        """After step number ``steps`` from this state; whether it is to be shown.

        ``asked``: the number of the last goal that the step knew of. ``alone``: whether it is a
        single step, which is always shown.
        """
        record = stage.policy.controller.latest()
        self._plan_ms.append(float(record.plan_ms[0]))
        belief, labels = record.estimated[0], stage.labels(observation)
        # A belief of 0 is about an edge beyond the model's cutoff, right by construction.
        counted = (belief > 0.0) | labels
        self._calibration += belief_calibration(belief[counted], labels[counted])
        now, dt = time.perf_counter(), stage.task.scene.dt
        if not alone and now - self._last < min(dt, 1.0 / _FRAMES_A_SECOND) - _EARLY:
            return False
        self._last = now
        shown = _motion(observation, control, record, stage.inverse_mass(), links, labels)
        self._motion = {**shown, "step": steps - 1, "time": (steps - 1) * dt, "acted": asked}
        return True

    def publish(
        self, controls: dict[str, Any], stage: Stage | None, episode: Episode | None
    ) -> None:
        """Makes the newest message; ``controls`` are what pages can set, and the count."""
        values = {
            **self._motion,
            **controls,
            "type": "frame",
            "scene": self._scene,
            "notice": {"number": self._notices, "text": self._notice},
            "reliability": _reliability(self._calibration),
        }
        if stage is not None and episode is not None:
            goal, position = stage.task.scene.goal, episode.observation["position"]
            if goal is not None:
                position = position[stage.task.cost_terms().ending_nearest(position, goal)[-1]]
            distance = None if goal is None else number(float(np.linalg.norm(position - goal)))
            values |= {
                "goal": None if goal is None else goal.tolist(),
                "distance": distance,
                "reached": distance is not None and distance <= self._goal_radius,
                "medianMs": float(np.median(self._plan_ms)) if self._plan_ms else None,
            }
        self.newest = (self.newest[0], _json(values))


def _scene_of(scene: Scene, name: str, episode: Episode, control_size: int) -> SceneTrajectory:
    """A scene at rest as it begins, for the renderer of reports."""
    observation, links = episode.observation, episode.link_positions

    def twice(value: np.ndarray | None) -> Any:
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


def _motion(
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


def _reliability(calibration: Calibration) -> dict[str, Any] | None:
    """As a curve of the report's chart; None before any belief was counted."""
    rows = calibration.reliability
    if rows is None:
        return None
    bins = [row for row in rows if row[0]]
    return {"source": "this session", "bins": bins, "error": calibration.expected_error}


def _rounded(values: np.ndarray) -> list[float | None]:
    flat = np.round(np.asarray(values, np.float64).ravel(), _DIGITS)
    return [value if np.isfinite(value) else None for value in flat.tolist()]


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False, separators=(",", ":"))
