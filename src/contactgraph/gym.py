"""Tasks as Gymnasium makes them: ``gymnasium.make("contactgraph/Pickup-v0")``.

The import of this module registers them; ``pusht-pose`` is ``contactgraph/PushtPose-v0``.
"""

from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation
from contactgraph.envs.episodes import EpisodeStates
from contactgraph.envs.registry import make, task_names


class GymnasiumTask(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A task by its name that is drawn on request; a `contactgraph.envs.Task` itself.

    ``options`` are those of `contactgraph.make`. Raises `InvalidInputError` as that does, and for
    an unknown ``render_mode``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise InvalidInputError(f"render_mode must be rgb_array or None, found {render_mode!r}")
        self.task = make(task, **options)
        self.render_mode = render_mode
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space
        self.max_steps = self.task.max_steps
        self._name = task
        self._states: EpisodeStates | None = None
        if render_mode is not None:
            # Another task: a seed would determine the episodes of this one.
            other = make(task, **options)
            other.reset(seed=0)
            self.metadata = {**self.metadata, "render_fps": round(1.0 / other.scene.dt)}

    @property
    def scene(self) -> Scene:
        """The current episode's scene."""
        return self.task.scene

    def success(self) -> bool:
        """Whether the episode has ended as the task demands."""
        return self.task.success()

    def cost_terms(self) -> ChainCost:
        """The task as a cost."""
        return self.task.cost_terms()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode."""
        super().reset(seed=seed)
        observation, info = self.task.reset(seed=seed, options=options)
        self._states = EpisodeStates(self.task, observation)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by ``scene.dt``."""
        stepped = self.task.step(action)
        if self._states is not None and self.render_mode is not None:
            self._states.add(stepped[0])
        return stepped

    def render(self) -> np.ndarray | None:
        """[height, width, 3] uint8: the scene, and the way since the episode's start.

        None without a ``render_mode``.
        """
        from contactgraph.viz import recorded_scene
        from contactgraph.viz.animation import frames

        if self.render_mode is None:
            return None
        if self._states is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        control = np.zeros((len(self._states), *cast(tuple[int, ...], self.action_space.shape)))
        trajectory = self._states.trajectory(control, self.scene)
        return next(frames(recorded_scene(self._name, trajectory), [len(self._states) - 1]))

    def close(self) -> None:
        """Closes the task."""
        cast(gymnasium.Env[Any, Any], self.task).close()


for _task in task_names():
    gymnasium.register(
        id=f"contactgraph/{''.join(map(str.capitalize, _task.split('-')))}-v0",
        entry_point="contactgraph.gym:GymnasiumTask",
        kwargs={"task": _task},
    )
