"""Runs a policy in a task and records the trajectory."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.envs.contract import (
    FeedbackPolicy,
    FeedbackTask,
    InformedPolicy,
    Observation,
    Policy,
    Renderable,
    ScoredTask,
    Task,
)
from contactgraph.parallel import Executor, map_if_faster


def run_episode(task: Task, policy: Policy, seed: int) -> Trajectory:
    """Runs one `Episode` to its end and records it: ``T`` controls, ``T + 1`` states and contacts.

    Raises `InvalidInputError` where the seed is negative.
    """
    episode = Episode(task, policy, seed)
    while not episode.over:
        episode.step()
    return episode.trajectory()


class Episode:
    """One episode of a policy in a task, step by step.

    ``seed`` samples the scene (``task.reset(seed=seed)``), and the policy's seed is derived from
    it. If both task and policy support it, feedback acts within the steps, and controls are
    their means. A task that is `Renderable` has its link positions recorded at every state, and
    what a task observes of holding and of orientation is recorded.
    """

    def __init__(self, task: Task, policy: Policy, seed: int) -> None:
        """Begins the episode; raises `InvalidInputError` where the seed is negative."""
        if seed < 0:
            raise InvalidInputError(f"seed must be at least 0, found {seed}")
        self._task, self._policy = task, policy
        self._box = cast(gymnasium.spaces.Box, task.action_space)
        self.observation, _ = task.reset(seed=seed)
        """The present one."""
        self.over = False
        """Whether the task has ended the episode."""
        # A separate stream: noise drawn from the scene's numbers would depend on the layout.
        policy.reset(task.scene, int(np.random.SeedSequence(seed).generate_state(1)[0]))
        self._states = EpisodeStates(task, self.observation)
        self._controls: list[np.ndarray] = []

    @property
    def steps(self) -> int:
        """The steps made."""
        return len(self._controls)

    @property
    def link_positions(self) -> np.ndarray | None:
        """[P, D] m: those of a `Renderable` task at present."""
        return self._states.link_positions

    def step(self) -> np.ndarray:
        """Makes one step; the control ``[U]`` N that was applied, on its mean."""
        task, policy, box = self._task, self._policy, self._box
        control = np.clip(policy(self.observation), box.low, box.high).astype(box.dtype)
        if isinstance(task, FeedbackTask) and isinstance(policy, FeedbackPolicy):
            following, _, terminated, truncated, info = task.step_under(policy.feedback())
            control = info["control"]
        else:
            following, _, terminated, truncated, _ = task.step(control)
        if isinstance(policy, InformedPolicy):
            policy.applied(control)
        self.observation, self.over = following, terminated or truncated
        self._states.add(following)
        self._controls.append(control)
        return control

    def trajectory(self) -> Trajectory:
        """The states and controls so far, at least one.

        The scene's metadata gains the policy's class name and the episode's success.
        """
        task = self._task
        metadata = {
            **task.scene.metadata,
            "policy": type(self._policy).__name__,
            "success": task.success(),
        }
        best_score = task.best_score() if isinstance(task, ScoredTask) else None
        if best_score is not None:
            metadata["best_score"] = best_score
        scene = replace(task.scene, metadata=metadata)
        return self._states.trajectory(np.stack(self._controls), scene)


class EpisodeStates:
    """The states of a running episode, from its first observation on."""

    def __init__(self, task: Task, first: Observation) -> None:
        self._drawn = task if isinstance(task, Renderable) else None
        self._observations: list[Observation] = []
        self._link_positions: list[np.ndarray] = []
        self.add(first)

    def __len__(self) -> int:
        return len(self._observations)

    @property
    def link_positions(self) -> np.ndarray | None:
        """[P, D] m: those of the last state of a `Renderable` task."""
        return self._link_positions[-1] if self._link_positions else None

    def add(self, observation: Observation) -> None:
        """Keeps the present state."""
        self._observations.append(observation)
        if self._drawn is not None:
            # A copy: a simulator may return views of its own state.
            self._link_positions.append(np.array(self._drawn.link_positions()))

    def trajectory(self, control: np.ndarray, scene: Scene) -> Trajectory:
        """The states under ``control`` [T, U]; the last one is repeated where T + 1 are more."""
        index = np.minimum(np.arange(len(control) + 1), len(self) - 1)

        def recorded(name: str) -> Any:
            if name not in self._observations[0]:
                return None
            return np.stack([each[name] for each in self._observations])[index]

        position, velocity, contact = map(recorded, ("position", "velocity", "contact"))
        links = np.stack(self._link_positions)[index] if self._link_positions else None
        return Trajectory(
            scene,
            position,
            velocity,
            control,
            contact=contact.astype(bool),
            link_positions=links,
            holding=recorded("holding"),
            orientation=recorded("orientation"),
            angular_velocity=recorded("angular_velocity"),
        )


def collect(
    task_factories: Sequence[Callable[[], Task]],
    policies: Sequence[Policy],
    episodes: int,
    seed: int,
    on_episode: Callable[[Trajectory], None] | None = None,
    executor: Executor | None = None,
    recorded: Sequence[Trajectory] = (),
) -> list[Trajectory]:
    """Records ``episodes`` episodes; episode ``i`` is by ``policies[i % len(policies)]``.

    Its task is by ``task_factories[i % len(task_factories)]``. A mix of policies is a longer list:
    ``[expert] * 8 + [ExplorationPolicy(), RestPolicy()]`` explores in every tenth episode and rests
    in every tenth.

    Each episode has a seed of its own, spawned from ``seed``, so that episode ``i`` is the same for
    any number of episodes and workers. The scene's metadata names the seed; `run_episode` with it
    repeats the episode.

    ``on_episode`` receives the trajectories in order. The workers of ``executor`` record if that
    saves time; factories and policies must then be picklable, which a lambda is not. ``recorded``
    are the first trajectories, from an earlier call. Raises `InvalidInputError` where a count or
    the seed is out of range.
    """
    if not policies:
        raise InvalidInputError("policies must name at least one policy, found none")
    if not task_factories:
        raise InvalidInputError("task_factories must name at least one task, found none")
    seeds = episode_seeds(episodes, seed)
    recorder = partial(_recorder, tuple(task_factories), tuple(policies), seeds)
    trajectories = list(recorded[:episodes])
    with closing(map_if_faster(executor, recorder, range(len(trajectories), episodes))) as made:
        for trajectory in made:
            trajectories.append(trajectory)
            if on_episode is not None:
                on_episode(trajectory)
    return trajectories


def episode_seeds(episodes: int, seed: int) -> list[int]:
    """A seed for every episode; seed ``i`` is the same for any number of episodes.

    Raises `InvalidInputError` where a count or the seed is out of range.
    """
    if episodes < 1:
        raise InvalidInputError(f"episodes must be at least 1, found {episodes}")
    if seed < 0:
        raise InvalidInputError(f"seed must be at least 0, found {seed}")
    return [episode_seed(each, seed) for each in range(episodes)]


def episode_seed(index: int, seed: int) -> int:
    """That of one episode; see `episode_seeds`."""
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def fixed_seed(seed: int) -> int:
    """The seed of the layout that all episodes of a dataset share; its stream is separate."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def _recorder(
    task_factories: Sequence[Callable[[], Task]], policies: Sequence[Policy], seeds: Sequence[int]
) -> Callable[[int], Trajectory]:
    """Records episode ``i``, independently of those before it."""
    tasks = [task_factory() for task_factory in task_factories]

    def record(index: int) -> Trajectory:
        task, policy = tasks[index % len(tasks)], policies[index % len(policies)]
        return run_episode(task, policy, seeds[index])

    return record
