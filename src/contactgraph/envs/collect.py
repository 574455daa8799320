"""Recording many runs, in this process or by an engine's workers."""

import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.run_episode import run_episode
from contactgraph.parallel import Engine, answers_in_order

_ALONE_S = 1.0
"""For so long one process records, whatever there is to do: it tells how long a run takes."""
_START_S = 1.0
"""What starting workers takes, by measurement."""


def collect(
    task_factories: Sequence[Callable[[], Task]],
    policies: Sequence[Policy],
    episodes: int,
    seed: int,
    on_episode: Callable[[Trajectory], None] | None = None,
    engine: Engine | None = None,
    recorded: Sequence[Trajectory] = (),
) -> list[Trajectory]:
    """Records ``episodes`` runs; run ``i`` is by ``policies[i % len(policies)]``.

    Its task is by ``task_factories[i % len(task_factories)]``: one of them gives runs alike,
    several take turns, and runs of different scenes come mixed.

    A mix is a longer list: ``[expert] * 8 + [ExplorationPolicy(), RestPolicy()]`` explores in
    every tenth run and rests in every tenth. Each run has a seed of its own, spawned from
    ``seed``, so that run ``i`` is the same however many are recorded, and by whom; its scene's
    metadata names it, and `run_episode` with it gives that run again.

    ``on_episode`` is called with every run as it is done, in order. This process records, or, where
    there is so much to do that starting them pays, an ``engine``'s workers; then factories and
    policies must be what an `Engine` can send, which a lambda is not. ``recorded`` are the first
    runs where an earlier call had come so far; they are not made again. Raises `InvalidInputError`
    where a count or the seed is out of range.
    """
    if not policies:
        raise InvalidInputError("policies must name at least one policy, found none")
    if not task_factories:
        raise InvalidInputError("task_factories must name at least one task, found none")
    wanted = _Runs(tuple(task_factories), tuple(policies), episode_seeds(episodes, seed))
    runs = list(recorded[:episodes])
    with closing(_made(wanted, range(len(runs), episodes), engine)) as made:
        for run in made:
            runs.append(run)
            if on_episode is not None:
                on_episode(run)
    return runs


def episode_seeds(episodes: int, seed: int) -> list[int]:
    """A seed for every episode; seed ``i`` is the same however many there are.

    Raises `InvalidInputError` where a count or the seed is out of range.
    """
    if episodes < 1:
        raise InvalidInputError(f"episodes must be at least 1, found {episodes}")
    if seed < 0:
        raise InvalidInputError(f"seed must be at least 0, found {seed}")
    children = np.random.SeedSequence(seed).spawn(episodes)
    return [int(child.generate_state(1)[0]) for child in children]


def fixed_seed(seed: int) -> int:
    """The seed of what all episodes of a data set share: of a stream apart from theirs."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


@dataclass(frozen=True)
class _Runs:
    """What is to be recorded."""

    task_factories: tuple[Callable[[], Task], ...]
    policies: tuple[Policy, ...]
    seeds: list[int]

    def recorder(self) -> Callable[[int], Trajectory]:
        """Records run ``i``, the same whatever was recorded before it."""
        tasks = [task_factory() for task_factory in self.task_factories]

        def record(index: int) -> Trajectory:
            task, policy = tasks[index % len(tasks)], self.policies[index % len(self.policies)]
            return run_episode(task, policy, self.seeds[index])

        return record


def _made(
    wanted: _Runs, numbers: range, engine: Engine | None
) -> Generator[Trajectory, None, None]:
    """The runs of these numbers, in order."""
    record, began = wanted.recorder(), time.perf_counter()
    for done, index in enumerate(numbers):
        spent, left = time.perf_counter() - began, len(numbers) - done
        if done and engine is not None and spent > _ALONE_S:
            alone = spent / done * left
            if alone * (1.0 - 1.0 / engine.workers) > _START_S:
                yield from answers_in_order(engine, wanted.recorder, numbers[done:])
                return
        yield record(index)
