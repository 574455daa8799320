"""Forced windows: recorded episodes, simulated on from their states under random controls.

The controls of an expert that sees what is hidden tell it: one that pulls at a body holds it. A
constant control that is drawn at random tells nothing, so only beliefs from the past can help.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.data.schema import given_fields
from contactgraph.envs.contract import Observation, Task
from contactgraph.envs.episodes import EpisodeStates
from contactgraph.envs.planar.world import ENGINES
from contactgraph.envs.registry import make, task_names, task_spec

EVERY = 12
"""States from the start of one window to that of the next."""
FORCES = (0.5, 3.0)
"""The weakest and the strongest forced control, N."""


def recorded_task(dataset: Dataset, trajectory: Trajectory) -> Task:
    """The task of an episode in a dataset, with the options and the engine of its metadata.

    Raises `InvalidInputError` where these name no planar task, or no seed. A file does not get to
    import a class: it names tasks only.
    """
    metadata = {**dataset.metadata, **trajectory.scene.metadata}
    name, engine = str(metadata.get("task")), str(metadata.get("simulator")).partition(" ")[0]
    seeded = isinstance(trajectory.scene.metadata.get("seed"), int)
    if engine not in ENGINES or name not in task_names() or not seeded:
        raise InvalidInputError(
            "forced windows need episodes of planar tasks, recorded by collect, with their seeds; "
            f"found task {name}, simulator {metadata.get('simulator')}"
        )
    arguments = task_spec(name).options
    options = {each: value for each, value in metadata.items() if each in arguments}
    return make(name, **{**options, "engine": engine})


@dataclass(frozen=True, eq=False)
class Branch:
    """A task in a state of a recorded episode, and the control under which it goes on."""

    recorded: Trajectory
    start: int
    """The state."""
    task: Task
    """In that state, with all that is hidden."""
    observation: Observation
    """Of that state."""
    control: np.ndarray
    """[U] N, constant."""

    def trajectory(self, steps: int) -> Trajectory:
        """The recorded states before the start, then ``steps`` steps of the task from there."""
        states = EpisodeStates(self.task, self.observation)
        for _ in range(steps):
            states.add(self.task.step(self.control)[0])
        after = states.trajectory(np.tile(self.control, (steps, 1)), self.recorded.scene)
        whole: dict[str, Any] = {
            name: np.concatenate([getattr(self.recorded, name)[: self.start], getattr(after, name)])
            for name in given_fields(after)
        }
        return replace(after, **whole)


def branches(
    task: Task, trajectory: Trajectory, steps: int, episode: int, every: int = EVERY
) -> Iterator[Branch]:
    """Replays a recorded episode in its ``task``, and branches off in every ``every``-th state.

    There are ``steps`` steps left from each of these states. The ``episode`` is the seed of the
    controls, each of which is uniform in its direction and, from 0.5 to 3 N, in its strength,
    within the task's bounds; switches are on or off. Raises `InvalidInputError` where the replay
    differs from the recording or the control is no force.
    """
    scene, recorded = trajectory.scene, trajectory.control
    rng = np.random.default_rng([0, episode])
    kinds = scene.control_kind or ("force",) * trajectory.control_size
    if not kinds or not set(kinds) <= {"force", "switch"}:
        found = ", ".join(sorted(set(kinds))) or "nothing"
        raise InvalidInputError(f"forced windows need controls that are forces, found {found}")
    seed = cast(int, scene.metadata.get("seed"))
    observation, _ = task.reset(seed=seed)
    for state in range(trajectory.steps + 1):
        for name in ("position", "velocity"):
            if not np.array_equal(observation[name], getattr(trajectory, name)[state]):
                raise InvalidInputError(
                    f"forced windows need a replay, but that of the episode of seed {seed} differs "
                    f"from the recording: {name} in state {state} of {trajectory.steps}"
                )
        if state % every == 0 and state + steps <= trajectory.steps:
            control = _drawn(kinds, cast(gymnasium.spaces.Box, task.action_space), rng)
            yield Branch(trajectory, state, copy.deepcopy(task), observation, control)
        if state < trajectory.steps:
            observation = task.step(recorded[state])[0]


def _drawn(
    kinds: tuple[str, ...], bounds: gymnasium.spaces.Box, rng: np.random.Generator
) -> np.ndarray:
    """[U] N."""
    force = np.array([kind == "force" for kind in kinds])
    direction = rng.normal(size=len(kinds)) * force
    strength = rng.uniform(*FORCES) / np.linalg.norm(direction)
    switched = rng.integers(2, size=len(kinds))
    return np.clip(np.where(force, strength * direction, switched), bounds.low, bounds.high)


def forced_windows(
    dataset: Dataset, task_of: Callable[[Trajectory], Task], steps: int, every: int = EVERY
) -> tuple[Dataset, tuple[int, ...]]:
    """A trajectory for each forced window, which is its end, and the index of its episode.

    The windows have ``steps`` steps, from every ``every``-th state of every episode on: see
    `branches`; the index of an episode is the seed of its controls. ``task_of`` makes the task of
    an episode. Raises `InvalidInputError` as `branches`.
    """
    windows = [
        (index, branch.trajectory(steps))
        for index, each in enumerate(dataset)
        for branch in branches(task_of(each), each, steps, index, every)
    ]
    episode, trajectories = zip(*windows, strict=True)
    return replace(dataset, trajectories=trajectories), episode
