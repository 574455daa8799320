"""A session: one thread that owns the task, the controller and its beliefs.

Wishes come in by a queue and are acted on between two steps; frames go out as the newest one, so
that no reader makes the session wait. Stages are compiled by a thread of their own while the
present one goes on.
"""

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from contactgraph.data import InvalidInputError, Trajectory, write_trajectories
from contactgraph.envs.episodes import episode_seed
from contactgraph.evaluate import Episode
from contactgraph.play.frames import View
from contactgraph.play.stage import BuiltStage, Stage, StageParts, build_stage
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
from contactgraph.policies import switches_of

_WAITING = 200
"""Wishes that may wait for the session."""
_SOON = 0.1
"""s; what is acted on longer before the next step is shown at once."""
_SWITCH = {"auto": None, "off": 0.0, "on": 1.0}


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
        self._episodes = self._successes = 0
        self._inbox: queue.Queue[Wish | BuiltStage] = queue.Queue(_WAITING)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="session", daemon=True)
        self.on_change: Callable[[], None] = lambda: None
        """Called, in the session's thread, when there is a new message or the session is over."""
        self.failure: BaseException | None = None
        """The error that has ended the session."""
        self.trajectories: list[Trajectory] = []
        """The finished episodes, where they are recorded."""
        self._wanted: StageChoice | None = None
        self._building: StageChoice | None = choice
        self._first = Stage(choice, open_parts(choice), self._episode_seed())
        self._stage: Stage | None = None
        self._episode: Episode | None = None
        self._view = View()
        self._paused, self._speed, self._single = False, 1.0, False
        self._sensor, self._switch = "exact", "auto"
        self._pulled: Pull | None = None
        self._asked = 0
        self._unwritten: InvalidInputError | None = None
        self._notes: dict[str, int] = {}

    def start(self) -> None:
        """Begins; the first stage is compiled first."""
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether the session has ended."""
        return self._stopped.is_set()

    @property
    def compiling(self) -> bool:
        """Whether a stage is being compiled, which a process that ends waits for."""
        return self._building is not None

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
            build_stage(lambda: self._first, self._inbox.put)
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
        except BaseException as error:  # told to the thread that waits for the session
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
                self._view.tell(str(error))
            acted = True
            if self._paused or self._episode is None:
                break
        if acted and (self._paused or self._episode is None or wait > _SOON):
            self._publish()

    def _act(self, wish: Wish | BuiltStage) -> None:
        match wish:
            case MoveGoal():
                self._move_goal(wish)
            case Pull():
                self._running()[0].check_place(wish.to, wish.node)
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
            case BuiltStage():
                self._take_stage(wish)

    def _move_goal(self, wish: MoveGoal) -> None:
        stage, episode = self._running()
        stage.check_place(wish.goal).move_goal(wish.goal)
        episode.observation = {**episode.observation, "goal": wish.goal}
        self._asked = wish.number
        self._notes["goal_moves"] = self._notes.get("goal_moves", 0) + 1

    def _running(self) -> tuple[Stage, Episode]:
        if self._stage is None or self._episode is None:
            raise InvalidInputError("no episode has begun yet")
        return self._stage, self._episode

    def _set_switch(self, switch: str) -> None:
        stage, _ = self._running()
        if not switches_of(stage.task.scene):
            raise InvalidInputError("this task has no switch")
        self._switch = switch
        stage.policy.switch = _SWITCH[switch]

    def _choose(self, wish: StageChoice) -> None:
        if wish.model not in self._models or wish.task not in self._tasks:
            raise InvalidInputError("models and tasks are those that the page lists")
        self._wanted = wish
        self._view.tell(f"compiling {wish.model} in {wish.task}; meanwhile this goes on")

    def _build_wanted(self) -> None:
        if self._wanted is None or self._building is not None:
            return
        choice, self._building, self._wanted = self._wanted, self._wanted, None
        before, seed = self._stage, self._episode_seed()
        build_stage(lambda: Stage(choice, self._open_parts(choice), seed, before), self._inbox.put)

    def _take_stage(self, built: BuiltStage) -> None:
        self._building = None
        stage = built.stage
        if stage is None and self._stage is None:
            raise RuntimeError(built.reason)
        if stage is None:
            raise InvalidInputError(built.reason)
        if self._record is not None and self._stage is not None and not stage.agrees(self._stage):
            raise InvalidInputError(
                "recorded episodes must agree in time step and control; record others apart"
            )
        self._end_episode()
        if self._stage is None or not stage.same_program(self._stage):
            self._view = View(self._view)
        self._stage, self._switch = stage, "auto"
        self._begin()

    def _begin_next(self) -> None:
        self._running()
        self._end_episode()
        self._begin()

    def _episode_seed(self) -> int:
        return episode_seed(self._episodes, self._seed)

    def _begin(self) -> None:
        stage = self._stage
        assert stage is not None
        self._episode = Episode(stage.task, stage.policy, self._episode_seed())
        stage.policy.sense(self._sensor)
        self._pulled, self._notes = None, {}
        self._view.begin(stage, self._episode, {"models": self._models, "tasks": self._tasks})
        self._publish()

    def _end_episode(self) -> None:
        episode, self._episode = self._episode, None
        self._pulled = None
        if episode is None or self._stage is None or not episode.steps:
            return
        self._successes += self._stage.task.success()
        self._episodes += 1
        trajectory = episode.trajectory()
        noted = {**trajectory.scene.metadata, **self._notes}
        trajectory = replace(trajectory, scene=replace(trajectory.scene, metadata=noted))
        if self._record is not None:
            self.trajectories.append(trajectory)
            try:
                write_trajectories(self._record, self.trajectories, {"made_by": "play"})
                self._unwritten = None
            except InvalidInputError as error:
                self._unwritten = error
                self._view.tell(str(error))

    def _step(self) -> float:
        """Makes a step; its duration, s."""
        stage, episode = self._running()
        if self._pulled is not None:
            stage.pull(episode.observation, self._pulled.node, self._pulled.to)
            self._notes["pulled_steps"] = self._notes.get("pulled_steps", 0) + 1
        self._single = False
        observation, links = episode.observation, episode.link_positions
        control = episode.step()
        made = episode.steps, observation, links, control
        if self._view.step(stage, *made, self._asked, self._paused):
            self._publish()
        if episode.over:
            self._begin_next()
        return stage.task.scene.dt

    def _publish(self) -> None:
        controls = {
            "episodes": self._episodes,
            "successes": self._successes,
            "paused": self._paused,
            "speed": self._speed,
            "sensor": self._sensor,
            "switch": self._switch,
            "compiling": None if self._building is None else self._building.task,
        }
        self._view.publish(controls, self._stage, self._episode)
        self.on_change()

    @property
    def newest(self) -> tuple[str | None, str | None]:
        """The newest message about the scene, and that about the motion in it."""
        return self._view.newest
