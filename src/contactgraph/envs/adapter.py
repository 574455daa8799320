"""Tasks made of other people's Gymnasium environments."""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation
from contactgraph.envs.environment_map import Entries, EnvironmentMap
from contactgraph.envs.pose_reader import BodyState, read_state

_LARGEST = 1e6
"""Bound of the observation space, m, m/s: `check_env` warns about infinite bounds."""
_START_TRIES = 1000


class WatchedContact(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment of two bodies, which knows whether they touched at any time in a step."""

    touched = False


def watched_contact(environment: gymnasium.Env[Any, Any]) -> np.ndarray:
    """[2, 2] bool: whether the bodies of a `WatchedContact` touched in the last step."""
    assert isinstance(environment, WatchedContact)
    return environment.touched * ~np.eye(2, dtype=bool)


class AdaptedTask(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A Gymnasium environment as a `contactgraph.envs.Task`.

    ``make_environment`` makes the environment, ``environment_map`` tells its bodies, its control
    and its goal. An episode ends after ``max_steps`` steps, where the environment ends it, or
    where a body leaves its bounds. The reward is the environment's own.

    A start in which an actuated body touches another one, or a body is out of its bounds, is
    replaced by the next one of the same random stream.

    Raises `InvalidInputError` where the map does not fit the environment, and, from `reset` and
    `step`, where the environment raises.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        make_environment: Callable[[], gymnasium.Env[Any, Any]],
        environment_map: EnvironmentMap,
    ) -> None:
        self.environment = make_environment()
        self.environment_map = environment_map
        environment_map.check(self.environment)
        self.max_steps = environment_map.max_steps
        self.action_space = _control_space(self.environment, environment_map)
        self.observation_space = _observation_space(environment_map)
        self._scene: Scene | None = None
        self._state: BodyState | None = None
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
            self._state = read_state(self.environment_map, raw, None)
            if self._inside() and not self._contact()[self._actuated()].any():
                self._scene = self._make_scene(raw, scene_seed)
                return self._observation(), {}
        raise InvalidInputError(
            f"{self.environment_map.name}: in {_START_TRIES} starts after seed {scene_seed} an "
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
        if self.environment_map.score_key is not None:
            self._best = max(self._best, float(self._info[self.environment_map.score_key]))
        self._state = read_state(self.environment_map, raw, self._state)
        terminated = bool(terminated) or not self._inside()
        truncated = bool(truncated) or self._steps == self.max_steps
        self._over = terminated or truncated
        info = {**self._info, "success": self.success()}
        return self._observation(), float(reward), terminated, truncated, info

    def success(self) -> bool:
        """Whether the episode is over with every body in its bounds and the goal reached."""
        if self._state is None or not (self._over and self._steps and self._inside()):
            return False
        key, tolerance = self.environment_map.success_key, self.environment_map.tolerance
        if tolerance is None:
            if key not in self._info:
                raise InvalidInputError(
                    f"map of {self.environment_map.name}: success_key must be one of "
                    f"{', '.join(self._info)}; found {key!r}"
                )
            return bool(self._info[key])
        last = self._state.position[self.environment_map.cost.chain[-1]]
        return bool(np.linalg.norm(last - self.scene.goal) <= tolerance)

    def best_score(self) -> float | None:
        """The best of the episode's scores. None: the environment has none."""
        return None if self.environment_map.score_key is None else self._best

    def cost_terms(self) -> ChainCost:
        """The map's cost."""
        return self.environment_map.cost

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
                f"{self.environment_map.name}: the environment raised "
                f"{type(error).__name__}: {text} (seed {seed}, step {self._steps})"
            ) from error

    def _environment_action(self, control: np.ndarray) -> np.ndarray:
        mapped, box = self.environment_map.control, self.environment.action_space
        assert isinstance(box, gymnasium.spaces.Box)
        action = np.full(box.shape, mapped.rest)
        offset = np.zeros(len(mapped.kind)) if mapped.offset is None else np.array(mapped.offset)
        action[list(mapped.entries)] = (control - offset) / np.array(mapped.scale)
        return np.clip(action, box.low, box.high).astype(box.dtype)

    def _actuated(self) -> list[bool]:
        return [body.actuated for body in self.environment_map.bodies]

    def _inside(self) -> bool:
        assert self._state is not None
        return all(
            body.bounds is None
            or bool(np.all((body.bounds[0] <= position) & (position <= body.bounds[1])))
            for body, position in zip(
                self.environment_map.bodies, self._state.position, strict=True
            )
        )

    def _contact(self) -> np.ndarray:
        """[N, N] bool."""
        assert self._state is not None
        if self.environment_map.contact is not None:
            return np.asarray(self.environment_map.contact(self.environment), dtype=bool)
        radius = np.array([body.radius for body in self.environment_map.bodies], dtype=np.float64)
        position = self._state.position
        distance = np.linalg.norm(position[:, None] - position, axis=-1)
        return (distance <= radius[:, None] + radius) & ~np.eye(len(radius), dtype=bool)

    def _observation(self) -> Observation:
        assert self._state is not None
        observation = {
            "position": self._state.position.copy(),
            "velocity": self._state.velocity.copy(),
            "contact": self._contact().astype(np.int8),
            "goal": np.array(self.scene.goal),
        }
        if self.environment_map.turns:
            observation["orientation"] = self._state.orientation.copy()
            observation["angular_velocity"] = self._state.angular_velocity.copy()
        return observation

    def _make_scene(self, raw: Any, seed: int) -> Scene:
        mapped, bodies = self.environment_map, self.environment_map.bodies
        known = {
            name: np.array(values, dtype=np.float64) if None not in values else None
            for name, values in (
                ("mass", [body.mass for body in bodies]),
                ("radius", [body.radius for body in bodies]),
            )
        }
        goal = mapped.goal
        outlines = [(i, each) for i, body in enumerate(bodies) for each in body.polygons]
        return Scene(
            node_name=tuple(body.name for body in bodies),
            node_type=tuple(body.type for body in bodies),
            actuated=np.array(self._actuated()),
            dt=mapped.dt,
            dimension=mapped.dimension,
            goal=mapped.scale * goal.read(raw) if isinstance(goal, Entries) else np.array(goal),
            gravity=None if mapped.gravity is None else np.array(mapped.gravity),
            mass=known["mass"],
            radius=known["radius"],
            size=_box_sizes(mapped),
            control_kind=mapped.control.kind,
            control_of=np.array(
                [[name == body.name for name in mapped.control.body] for body in bodies]
            ),
            planes=mapped.planes,
            polygons=tuple(outline for _, outline in outlines) or None,
            polygon_of=np.array([index for index, _ in outlines]) if outlines else None,
            metadata={"task": mapped.name, "seed": seed, **mapped.metadata},
        )


def _box_sizes(environment_map: EnvironmentMap) -> np.ndarray | None:
    """[N, D] m, NaN where a body is no box; None where none is."""
    sizes = [body.size for body in environment_map.bodies]
    none = (np.nan,) * environment_map.dimension
    return np.array([size or none for size in sizes]) if any(sizes) else None


def _control_space(
    environment: gymnasium.Env[Any, Any], environment_map: EnvironmentMap
) -> gymnasium.spaces.Box:
    mapped, box = environment_map.control, environment.action_space
    assert isinstance(box, gymnasium.spaces.Box)
    scale, entries = np.array(mapped.scale), list(mapped.entries)
    offset = np.zeros(len(scale)) if mapped.offset is None else np.array(mapped.offset)
    ends = np.stack([scale * box.low[entries] + offset, scale * box.high[entries] + offset])
    return gymnasium.spaces.Box(ends.min(axis=0), ends.max(axis=0), dtype=np.float64)


def _observation_space(environment_map: EnvironmentMap) -> gymnasium.spaces.Dict:
    count, dimension = len(environment_map.bodies), environment_map.dimension

    def box(*shape: int) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(-_LARGEST, _LARGEST, shape, np.float64)

    spaces: dict[str, gymnasium.spaces.Space[Any]] = {
        "position": box(count, dimension),
        "velocity": box(count, dimension),
        "contact": gymnasium.spaces.Box(0, 1, (count, count), np.int8),
        "goal": box(dimension),
    }
    if environment_map.turns:
        spaces["orientation"] = box(count, 1 if dimension == 2 else 4)
        spaces["angular_velocity"] = box(count, 1 if dimension == 2 else 3)
    return gymnasium.spaces.Dict(spaces)
