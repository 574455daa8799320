"""A session: one thread that owns the task, the controller and its beliefs.

Wishes come in by a queue and are acted on between two steps; frames go out as the newest one, so
that no reader makes the session wait. Stages are compiled by a thread of their own while the
present one goes on.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory, write_trajectories
from contactgraph.envs.contract import DisturbableTask
from contactgraph.evaluate import Episode, belief_calibration
from contactgraph.evaluate.calibration import no_calibration
from contactgraph.play import frames
from contactgraph.play.stage import Stage, StageParts, switches
from contactgraph.play.wishes import (
    MoveGoal,
    Pause,
    Pull,
    Release,
    Reset,
    SetSensor,
    SetSpeed,
    SetSwitch,
    SingleStep,
    StageChoice,
    Wish,
)
from contactgraph.viz.scene_payload import number

_FRAMES_A_SECOND = 60.0
_WAITING = 200
"""Wishes that may wait for the session."""
_RECENT = 100
"""Steps over which the time of a control step is told."""
_SOON = 0.1
"""s; what is acted on longer before the next step is shown at once."""
_SWITCH = {"auto": None, "off": 0.0, "on": 1.0}


@dataclass(frozen=True, eq=False)
class _Built:
    """A stage that is ready, or the reason why there is none."""

    stage: Stage | None
    reason: str = ""


class Session:
    """Episode after episode of a model in a task, under the wishes of pages.

    ``open_parts`` looks up what a choice names, and raises `InvalidInputError`; only names in
    ``models`` and ``tasks`` reach it. With ``record`` the episodes are written to that file.
    """

    def __init__(
        self,
        choice: StageChoice,
        open_parts: Callable[[StageChoice], StageParts],
        models: Sequence[str],
        tasks: Sequence[str],
        seed: int = 0,
        record: Path | None = None,
    ) -> None:
        """Raises `InvalidInputError` where the first choice names nothing, or does not fit."""
        self._open_parts, self._models, self._tasks = open_parts, tuple(models), tuple(tasks)
        self._seed, self._record = seed, record
        self._episodes = self._successes = self._notices = self._scenes = 0
        self._inbox: queue.Queue[Wish | _Built] = queue.Queue(_WAITING)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)
        self.on_change: Callable[[], None] = lambda: None
        """Called, in the session's thread, when there is a new message or the session is over."""
        self.newest: tuple[str | None, str | None] = (None, None)
        """The newest message about the scene, and that about the motion in it."""
        self.failure: BaseException | None = None
        """The error that has ended the session."""
        self.trajectories: list[Trajectory] = []
        """The finished episodes, where they are recorded."""
        self._wanted: StageChoice | None = None
        self._building: StageChoice | None = choice
        self._first = Stage(choice, open_parts(choice), self._episode_seed())
        self._stage: Stage | None = None
        self._episode: Episode | None = None
        self._motion: dict[str, Any] = {}
        self._notice: dict[str, Any] | None = None
        self._paused, self._speed, self._single = False, 1.0, False
        self._sensor, self._switch = "exact", "auto"
        self._pulled: Pull | None = None
        self._asked = 0
        self._goal_radius = 0.0
        self._unwritten: InvalidInputError | None = None
        self._notes: dict[str, int] = {}
        self._plan_ms: deque[float] = deque(maxlen=_RECENT)
        self._calibration = no_calibration()
        self._last_frame = 0.0

    def start(self) -> None:
        """Begins; the first stage is compiled first."""
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether the session has ended."""
        return self._stopped.is_set()

    def wish(self, wish: Wish) -> None:
        """Hands a wish to the session; raises `InvalidInputError` while too many wait."""
        try:
            self._inbox.put_nowait(wish)
        except queue.Full:
            raise InvalidInputError("too many wishes wait; this one is dropped") from None

    def stop(self) -> None:
        """Ends the session once its step is made; the present episode is recorded."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            self._start_build(self._building, lambda: self._first)
            due = time.perf_counter()
            while not self._stopped.is_set():
                self._build_wanted()
                standing = self._episode is None or (self._paused and not self._single)
                self._take_wishes(0.05 if standing else due - time.perf_counter())
                if self._episode is None or (self._paused and not self._single):
                    due = time.perf_counter()
                elif time.perf_counter() >= due:
                    # A session that is late goes on from now, and makes up for nothing.
                    due = max(due, time.perf_counter() - 0.02) + self._step() / self._speed
            self._end_episode()
            if self._unwritten is not None:
                raise self._unwritten
        except BaseException as error:  # told to whoever waits for the session
            self.failure = error
        finally:
            self._stopped.set()
            self.on_change()

    def _take_wishes(self, wait: float) -> None:
        """Acts on all wishes that are there, or come within ``wait`` s."""
        until = time.perf_counter() + wait
        acted = False
        while not self._stopped.is_set():
            left = until - time.perf_counter()
            try:
                each = self._inbox.get(timeout=left) if left > 0 else self._inbox.get_nowait()
            except queue.Empty:
                break
            try:
                self._act(each)
            except InvalidInputError as error:
                self._tell(str(error))
            acted = True
            if self._paused or self._episode is None:
                break
        if acted and (self._paused or self._episode is None or wait > _SOON):
            self._publish()

    def _act(self, wish: Wish | _Built) -> None:
        match wish:
            case MoveGoal():
                self._move_goal(wish)
            case Pull():
                self._check_disturbable(wish.node, wish.to)
                self._pulled = wish
            case Release():
                self._pulled = None
            case SetSensor():
                self._sensor = wish.sensor
                if self._stage is not None and self._episode is not None:
                    self._stage.policy.sense(wish.sensor)
            case SetSwitch():
                self._set_switch(wish.switch)
            case Pause():
                self._paused, self._single = wish.paused, False
            case SingleStep():
                self._paused = self._single = True
            case SetSpeed():
                self._speed = wish.speed
            case Reset():
                self._begin_next()
            case StageChoice():
                self._choose(wish)
            case _Built():
                self._take_stage(wish)

    def _move_goal(self, wish: MoveGoal) -> None:
        self._check_disturbable(0, wish.goal)
        assert self._stage is not None and self._episode is not None
        task = self._stage.task
        assert isinstance(task, DisturbableTask)
        task.move_goal(wish.goal)
        self._episode.observation = {**self._episode.observation, "goal": wish.goal}
        self._asked = wish.number
        self._notes["goal_moves"] = self._notes.get("goal_moves", 0) + 1

    def _check_disturbable(self, node: int, place: np.ndarray) -> None:
        if self._stage is None or self._episode is None:
            raise InvalidInputError("no episode has begun yet")
        if not self._stage.disturbable:
            raise InvalidInputError(f"{self._stage.choice.task}: its bodies are not ours to move")
        count, dimension = self._episode.observation["position"].shape
        if node >= count or len(place) != dimension:
            raise InvalidInputError(
                f"nodes are 0 to {count - 1}, and places have {dimension} numbers"
            )

    def _set_switch(self, switch: str) -> None:
        if self._stage is None or not switches(self._stage.task.scene):
            raise InvalidInputError("this task has no switch")
        self._switch = switch
        self._stage.policy.switch = _SWITCH[switch]

    def _choose(self, wish: StageChoice) -> None:
        if wish.model not in self._models or wish.task not in self._tasks:
            raise InvalidInputError("models and tasks are those that the page lists")
        self._wanted = wish
        self._tell(f"compiling {wish.model} in {wish.task}; meanwhile this goes on")

    def _build_wanted(self) -> None:
        if self._wanted is None or self._building is not None:
            return
        choice, self._building, self._wanted = self._wanted, self._wanted, None
        before, seed = self._stage, self._episode_seed()
        self._start_build(choice, lambda: Stage(choice, self._open_parts(choice), seed, before))

    def _start_build(self, choice: StageChoice | None, make: Callable[[], Stage]) -> None:
        """Makes and compiles a stage in a thread of its own."""

        def build() -> None:
            try:
                stage = make()
                stage.warm_up()
                built = _Built(stage)
            except Exception as error:  # told on the page: a model of the user's may raise any
                reason = str(error) if isinstance(error, InvalidInputError) else repr(error)
                built = _Built(None, " ".join(reason.split()))
            self._inbox.put(built)

        threading.Thread(target=build, name=f"compile {choice}", daemon=True).start()

    def _take_stage(self, built: _Built) -> None:
        self._building = None
        stage = built.stage
        if stage is None and self._stage is None:
            raise RuntimeError(built.reason)
        if stage is None:
            raise InvalidInputError(built.reason)
        if self._record is not None and self._stage is not None and not stage.agrees(self._stage):
            raise InvalidInputError(
                "recorded episodes must agree in time step and control; record another task anew"
            )
        self._end_episode()
        if self._stage is None or not stage.same_program(self._stage):
            self._plan_ms.clear()
            self._calibration = no_calibration()
        self._stage, self._notice, self._switch = stage, None, "auto"
        self._begin()

    def _begin_next(self) -> None:
        if self._stage is None:
            raise InvalidInputError("no episode has begun yet")
        self._end_episode()
        self._begin()

    def _episode_seed(self) -> int:
        """That of `contactgraph.evaluate.collect`."""
        key = np.random.SeedSequence(self._seed, spawn_key=(self._episodes,))
        return int(key.generate_state(1)[0])

    def _begin(self) -> None:
        stage = self._stage
        assert stage is not None
        self._episode = Episode(stage.task, stage.policy, self._episode_seed())
        stage.policy.sense(self._sensor)
        self._pulled, self._notes, self._motion = None, {}, {}
        self._scenes += 1
        self._publish_scene()

    def _end_episode(self) -> None:
        episode, self._episode = self._episode, None
        self._pulled = None
        if episode is None or self._stage is None or not episode.steps:
            return
        self._successes += self._stage.task.success()
        self._episodes += 1
        trajectory = frames.with_notes(episode.trajectory(), {**self._notes})
        if self._record is not None:
            self.trajectories.append(trajectory)
            try:
                write_trajectories(self._record, self.trajectories, {"made_by": "play"})
                self._unwritten = None
            except InvalidInputError as error:
                self._unwritten = error
                self._tell(str(error))

    def _step(self) -> float:
        """Makes a step; its duration, s."""
        stage, episode = self._stage, self._episode
        assert stage is not None and episode is not None
        if self._pulled is not None:
            stage.pull(episode.observation, self._pulled.node, self._pulled.to)
            self._notes["pulled_steps"] = self._notes.get("pulled_steps", 0) + 1
        self._single = False
        observation, links = episode.observation, episode.link_positions
        control = episode.step()
        record = stage.record()
        self._plan_ms.append(float(record.plan_ms[0]))
        labels = stage.labels(observation)
        self._count_beliefs(record.estimated[0], labels)
        if time.perf_counter() - self._last_frame > 1.0 / _FRAMES_A_SECOND or self._paused:
            self._last_frame = time.perf_counter()
            step = {"step": episode.steps - 1, "time": (episode.steps - 1) * stage.task.scene.dt}
            mass = stage.inverse_mass()
            shown = frames.motion(observation, control, record, mass, links, labels)
            self._motion = {**shown, **step, "acted": self._asked}
            self._publish()
        if episode.over:
            self._begin_next()
        return stage.task.scene.dt

    def _count_beliefs(self, belief: np.ndarray, labels: np.ndarray) -> None:
        # A belief of 0 is about an edge beyond the model's cutoff, right by construction.
        counted = (belief > 0.0) | labels
        self._calibration += belief_calibration(belief[counted], labels[counted])

    def _tell(self, text: str) -> None:
        self._notices += 1
        self._notice = {"number": self._notices, "text": text}

    def _publish_scene(self) -> None:
        stage, episode = self._stage, self._episode
        assert stage is not None and episode is not None
        scene, choice = stage.task.scene, stage.choice
        name = f"{choice.model} in {choice.task}"
        size = int(np.size(stage.task.action_space.sample()))
        drawn = frames.scene_of(scene, name, episode.observation, size, episode.link_positions)
        about = {
            "model": choice.model,
            "task": choice.task,
            "distractors": choice.distractors,
            "models": self._models,
            "tasks": self._tasks,
            "disturbable": stage.disturbable,
            "switches": bool(switches(scene)),
        }
        chain = stage.task.cost_terms().chain
        self._goal_radius = drawn.goal_radius
        text = frames.scene_message(drawn, self._scenes, chain, about)
        self.newest = (text, None)
        self._publish()

    def _publish(self) -> None:
        values: dict[str, Any] = {
            **self._motion,
            "scene": self._scenes,
            "episodes": self._episodes,
            "successes": self._successes,
            "paused": self._paused,
            "speed": self._speed,
            "sensor": self._sensor,
            "switch": self._switch,
            "notice": self._notice,
            "compiling": None if self._building is None else self._building.task,
            "reliability": frames.reliability(self._calibration),
        }
        if self._stage is not None and self._episode is not None:
            values |= self._progress(self._stage, self._episode)
        self.newest = (self.newest[0], frames.frame_message(values))
        self.on_change()

    def _progress(self, stage: Stage, episode: Episode) -> dict[str, Any]:
        scene, observation = stage.task.scene, episode.observation
        node = stage.task.cost_terms().chain[-1]
        distance = frames.goal_distance(scene, observation, node)
        return {
            "goal": None if scene.goal is None else scene.goal.tolist(),
            "distance": number(distance),
            "reached": distance is not None and distance <= self._goal_radius,
            "medianMs": float(np.median(self._plan_ms)) if self._plan_ms else None,
        }
