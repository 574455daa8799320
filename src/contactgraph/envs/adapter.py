"""Tasks made of other people's Gymnasium environments."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation
from contactgraph.envs.gripper_task import observation_space
from contactgraph.interchange.conversion import State, state_after
from contactgraph.interchange.map_entries import Entries
from contactgraph.interchange.measurements import MappedEpisode, map_scene
from contactgraph.interchange.recording import Column, Episode
from contactgraph.interchange.scene_map import SceneMap, read_map

ContactReader = Callable[[Any], np.ndarray]
"""Of an environment: which bodies touched in the last step, ``[N, N]`` bool, by its simulator."""

_LARGEST = 1e6
"""Bound of the observation space, m, m/s: `check_env` warns about infinite bounds."""
_START_TRIES = 1000
_ARRAY = ("observations", "observation.state")
"""Names of an observation that is an array: that of Minari, and that of LeRobot."""
_ACTION = ("actions", "action")


class WatchedContact(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment of two bodies, which knows whether they touched at any time in a step."""

    touched = False

    def contact(self) -> np.ndarray:
        """[2, 2] bool: whether the bodies touched in the last step."""
        return self.touched * ~np.eye(2, dtype=bool)


class AdaptedTask(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A Gymnasium environment as a `contactgraph.envs.Task`.

    ``make_environment`` makes the environment. ``scene_map`` tells its bodies, its control and its
    goal, as it does of a recording (a `SceneMap`, a file of one, or the name of one that ships):
    ``observations/KEY[0:3]`` are entries of the observation under a key, ``observations[0:3]``
    those of an observation that is an array, ``actions[0:3]`` those of the action. Entries of the
    action that are no control stay at ``rest``.

    ``cost`` names bodies by their indices in the map; the last of its chain is to reach the goal.
    Success is its distance of at most ``tolerance`` m at the end, or else the entry
    ``success_key`` of the environment's ``info``. ``score_key`` names an entry that tells how well
    a step is, the more the better. Without ``contact`` bodies touch where their radii reach. An
    episode ends after ``max_steps`` steps, where the environment ends it, or where a body leaves
    its bounds. The reward is the environment's own. The versions of ``packages`` are stored with
    recordings, and `contactgraph control` compares them.

    A start in which an actuated body touches another one, or a body is out of its bounds, is
    replaced by the next one of the same random stream.

    Raises `InvalidInputError` where the map does not fit the environment, and, from `reset` and
    `step`, where the environment raises.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        make_environment: Callable[[], gymnasium.Env[Any, Any]],
        scene_map: SceneMap | str | Path,
        *,
        name: str,
        cost: ChainCost,
        max_steps: int,
        tolerance: float | None = None,
        success_key: str | None = None,
        score_key: str | None = None,
        contact: ContactReader | None = None,
        rest: float = 0.0,
        packages: Sequence[str] = (),
        scene_metadata: Mapping[str, str] | None = None,
    ) -> None:
        self.environment = make_environment()
        self.map = scene_map if isinstance(scene_map, SceneMap) else read_map(str(scene_map))
        self.name, self.max_steps = name, max_steps
        self._cost, self._contact_reader = cost, contact
        self._tolerance, self._success_key, self._score_key = tolerance, success_key, score_key
        self._scene_metadata = {"task": name, **(scene_metadata or {})}
        if packages:
            versions = (f"{package} {version(package)}" for package in packages)
            self._scene_metadata["simulator"] = ", ".join(versions)
        bodies = self.map.bodies
        turning = [body.orientation is not None or body.keypoints is not None for body in bodies]
        box = self._action_box()
        self._entries, self._scale, self._offset = self._controlled(box)
        self._check(turning)
        self._rest = np.full(box.shape, rest)
        ends = np.stack([box.low[self._entries], box.high[self._entries]])
        ends = self._scale * ends + self._offset
        self.action_space = gymnasium.spaces.Box(
            ends.min(axis=0), ends.max(axis=0), dtype=np.float64
        )
        most = (_LARGEST, _LARGEST)
        self.observation_space = observation_space(
            len(turning), self.map.dimension, _LARGEST, *most, most if any(turning) else None
        )
        self._scene: Scene | None = None
        self._state: State = {}
        self._info: dict[str, Any] = {}
        self._steps, self._over, self._best = 0, True, -np.inf

    @property
    def scene(self) -> Scene:
        """The current episode's scene; its ``metadata["seed"]`` samples it again."""
        if self._scene is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._scene

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode of the environment; ``options`` are the environment's own."""
        super().reset(seed=seed)
        # Every episode has a seed, also if none is given.
        scene_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._steps, self._over, self._info, self._best = 0, False, {}, -np.inf
        start = partial(self.environment.reset, seed=scene_seed, options=options)
        for _ in range(_START_TRIES):
            raw, _ = self._guarded(scene_seed, start)
            start = partial(self.environment.reset, options=options)
            mapped = self.mapped(raw)
            self._state = state_after(mapped, None)
            actuated = [body.actuated for body in self.map.bodies]
            if self._inside() and not self._contact()[actuated].any():
                scene = map_scene(mapped, self._widths)
                self._scene = replace(scene, metadata={**self._scene_metadata, "seed": scene_seed})
                return self._observation(), {}
        raise InvalidInputError(
            f"{self.name}: in {_START_TRIES} starts after seed {scene_seed} an "
            "actuated body touches another one or a body is out of its bounds"
        )

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by ``scene.dt`` under the control ``action`` ``[U]``, clipped to its bounds."""
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over or not begun: call reset()")
        box = cast(gymnasium.spaces.Box, self.action_space)
        control = np.clip(np.asarray(action, dtype=np.float64), box.low, box.high)
        if not np.all(np.isfinite(control)):
            raise InvalidInputError(f"action must be finite, found {np.asarray(action).tolist()}")
        seed = int(self.scene.metadata["seed"])
        raw, reward, terminated, truncated, self._info = self._guarded(
            seed, lambda: self.environment.step(self._environment_action(control))
        )
        self._steps += 1
        if self._score_key is not None:
            self._best = max(self._best, float(self._info[self._score_key]))
        self._state = state_after(self.mapped(raw), self._state)
        terminated = bool(terminated) or not self._inside()
        truncated = bool(truncated) or self._steps == self.max_steps
        self._over = terminated or truncated
        info = {**self._info, "success": self.success()}
        return self._observation(), float(reward), terminated, truncated, info

    def success(self) -> bool:
        """Whether the episode is over with every body in its bounds and the goal reached."""
        if not (self._state and self._over and self._steps and self._inside()):
            return False
        if self._tolerance is None:
            if self._success_key not in self._info:
                raise InvalidInputError(
                    f"{self.name}: success_key must be one of {', '.join(self._info)}; found "
                    f"{self._success_key!r}"
                )
            return bool(self._info[self._success_key])
        last = self._state["position"][self._cost.chain[-1]]
        return bool(np.linalg.norm(last - self.scene.goal) <= self._tolerance)

    def best_score(self) -> float | None:
        """The best of the episode's scores. None: the environment has none."""
        return None if self._score_key is None else self._best

    def cost_terms(self) -> ChainCost:
        """The task's cost."""
        return self._cost

    def close(self) -> None:
        """Closes the environment."""
        self.environment.close()

    def _guarded(self, seed: int, call: Callable[[], Any]) -> Any:
        """Calls the environment; an error of its own becomes one line that names the step."""
        try:
            return call()
        except Exception as error:
            text = " ".join(str(error).split())
            raise InvalidInputError(
                f"{self.name}: the environment raised "
                f"{type(error).__name__}: {text} (seed {seed}, step {self._steps})"
            ) from error

    def mapped(self, raw: Any) -> MappedEpisode:
        """An observation as a recording of one row."""
        arrays = dict.fromkeys(_ARRAY, raw)
        if isinstance(raw, dict):
            arrays = {f"observations/{key}": value for key, value in raw.items()}
        columns = {
            name: Column(np.asarray(value, dtype=np.float64).reshape(1, -1))
            for name, value in arrays.items()
        }
        dt = self.map.dt
        assert dt is not None
        return MappedEpisode(Episode(self.name, columns), self.map, dt)

    def _environment_action(self, control: np.ndarray) -> np.ndarray:
        box, action = self._action_box(), self._rest.copy()
        action[self._entries] = (control - self._offset) / self._scale
        return np.clip(action, box.low, box.high).astype(box.dtype)

    def _inside(self) -> bool:
        return all(
            body.bounds is None
            or bool(np.all((body.bounds[0] <= position) & (position <= body.bounds[1])))
            for body, position in zip(self.map.bodies, self._state["position"], strict=True)
        )

    def _contact(self) -> np.ndarray:
        """[N, N] bool."""
        if self._contact_reader is not None:
            return np.asarray(self._contact_reader(self.environment), dtype=bool)
        radius = np.array([float(body.constants["radius"]) for body in self.map.bodies])
        position = self._state["position"]
        distance = np.linalg.norm(position[:, None] - position, axis=-1)
        return (distance <= radius[:, None] + radius) & ~np.eye(len(radius), dtype=bool)

    def _observation(self) -> Observation:
        return {
            **{name: value.copy() for name, value in self._state.items()},
            "contact": self._contact().astype(np.int8),
            "goal": np.array(self.scene.goal),
        }

    def _action_box(self) -> gymnasium.spaces.Box:
        box = self.environment.action_space
        if not isinstance(box, gymnasium.spaces.Box) or len(box.shape) != 1:
            self._fail(f"the environment's action_space must be a Box of shape (U,), found {box}")
        return cast(gymnasium.spaces.Box, box)

    def _controlled(self, box: gymnasium.spaces.Box) -> tuple[list[int], np.ndarray, np.ndarray]:
        """For each component of the control its entry of the action, scale and offset."""
        indices = dict.fromkeys(_ACTION, Column(np.arange(box.shape[0], dtype=np.float64)[None]))
        episode, entries, parts = Episode(self.name, indices), [], []
        for each in self.map.controls:
            plain = Entries(each.entries.where, each.entries.columns)
            found = plain.read(episode).values[0].astype(int)
            entries += found.tolist()
            each.entries.read(episode)  # refuses a wrong number of scales
            shape = found.shape
            parts.append(
                [np.broadcast_to(x, shape) for x in (each.entries.scale, each.entries.offset)]
            )
        self._widths = [len(scale) for scale, _ in parts]
        scale, offset = np.concatenate(parts, axis=1) if parts else np.zeros((2, 0))
        if not (np.isfinite(box.low[entries]) & np.isfinite(box.high[entries])).all():
            self._fail("the environment's action_space must be bounded")
        if not np.all(scale):
            self._fail("the scale of a control must not be 0")
        return entries, scale, offset

    def _check(self, turning: list[bool]) -> None:
        """Raises `InvalidInputError` where map, cost and environment do not fit."""
        bodies = self.map.bodies
        if self.map.dt is None or self.map.goal is None:
            self._fail("the map must have [time] dt and a goal")
        if not any(body.actuated for body in bodies):
            self._fail("at least one body must be actuated, found none")
        if (self._tolerance is None) == (self._success_key is None):
            self._fail("success needs a tolerance or a success_key, and not both")
        if max(self._cost.chain) >= len(bodies):
            self._fail(
                f"cost.chain must name bodies 0 to {len(bodies) - 1}, found {self._cost.chain}"
            )
        for body, turns in zip(bodies, turning, strict=True):
            if any(turning) and not turns:
                self._fail(f"{body.name}: orientation must be known, as another body's is")
            if self._contact_reader is None and "radius" not in body.constants:
                self._fail(f"{body.name} needs a radius, or the task a contact function")
        mapped = self.mapped(self.environment.observation_space.sample())
        try:
            state_after(mapped, None)
            map_scene(mapped, self._widths)
        except InvalidInputError as error:
            self._fail(str(error))

    def _fail(self, message: str) -> None:
        raise InvalidInputError(f"{self.name}: {message}")
