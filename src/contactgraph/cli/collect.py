"""``contactgraph collect``: record runs of a task."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Collect:
    """Record runs of a task by its scripted expert, and write them to a dataset file.

    Where it was interrupted, the same command goes on.
    """

    task: Positional[Annotated[str, arg(metavar="TASK")]]
    """The task: pickup, multi-pickup, door or franka (an arm; needs the extra mujoco)."""
    out: Annotated[Path, arg(metavar="FILE")]
    """The file to write (HDF5)."""
    episodes: int = 40
    """How many runs."""
    seed: int = 0
    """The same seed records the same runs."""
    distractors: int = 0
    """Bystanders: objects, 0 to 20, doors, 0 to 10, or blocks, 0 to 5."""
    objects: Annotated[int | None, arg(metavar="INT")] = None
    """Objects to pick up, 1 to 5, where the task has a choice (multi-pickup: 2)."""
    grasp: Annotated[str | None, arg(metavar="HOW")] = None
    """How fingers hold, where the task has some: friction or weld."""
    mixed: bool = False
    """Runs take turns at 0 to DISTRACTORS bystanders, and at 1 to OBJECTS objects if given."""
    goal: Annotated[str, arg(metavar="HOW")] = "sampled"
    """sampled: every run has its own goal and targets. fixed: all runs share them."""
    expert: Annotated[str, arg(metavar="WHO")] = "train"
    """train: with noise on its force, to learn masses from. demo: without, to learn costs from."""
    exploration: float = 0.0
    """Share of runs with random forces in place of the expert."""
    resting: float = 0.0
    """Share of runs without any force."""
    cluster: Annotated[str, arg(metavar="WHERE")] = "local"
    """local: one process a core. ray or ray:HOST:PORT: on the machines of a Ray cluster."""

    def run(self) -> None:
        """Record and write."""
        from contactgraph.cli.options import (
            check_episodes,
            check_seed,
            check_share,
            choice,
            open_executor,
        )
        from contactgraph.cli.output import check_writable, progress
        from contactgraph.cli.tasks import (
            TaskOptions,
            known_task,
            mixed_factories,
            task_factory,
        )
        from contactgraph.cli.unfinished_runs import UnfinishedRuns
        from contactgraph.data import InvalidInputError, Metadata, write_trajectories
        from contactgraph.envs import RestPolicy
        from contactgraph.envs.episodes import collect, fixed_seed

        check_episodes(self.episodes)
        check_seed(self.seed)
        shared = choice("--goal", self.goal, {"sampled": None, "fixed": fixed_seed(self.seed)})
        options = TaskOptions(self.distractors, self.objects, self.grasp, shared)
        if self.mixed:
            factories = mixed_factories(self.task, options)
        else:
            factories = [task_factory(self.task, options)]
        task = known_task(self.task)
        demonstrates = choice("--expert", self.expert, {"train": False, "demo": True})
        expert = task.demonstrator if demonstrates else task.expert
        check_share("--exploration", self.exploration)
        check_share("--resting", self.resting)
        if self.exploration + self.resting > 1.0:
            raise InvalidInputError("--exploration and --resting together must not exceed 1")
        if demonstrates and self.exploration + self.resting > 0.0:
            raise InvalidInputError(
                "--expert demo: every run is a demonstration, so --exploration and --resting must "
                "be left out"
            )
        check_writable(self.out)
        explores = round(self.exploration * self.episodes)
        rests = round(self.resting * self.episodes)
        experts = self.episodes - explores - rests
        policies = [expert() for _ in range(experts)]
        policies += [task.explorer() for _ in range(explores)]
        policies += [RestPolicy() for _ in range(rests)]
        unfinished = UnfinishedRuns(self.out, self._inputs())
        if unfinished.found:
            print(f"{self.out}: goes on after {len(unfinished.found)} of {self.episodes} runs")
        with (
            open_executor(self.cluster) as executor,
            progress("collecting", self.episodes) as steps,
            unfinished,
        ):
            runs = collect(
                factories,
                policies,
                self.episodes,
                self.seed,
                on_episode=lambda run: steps.advance(unfinished.add(run)),
                executor=executor,
                recorded=unfinished.found,
            )
        metadata: Metadata = {"task": self.task, "seed": self.seed, **options.metadata}
        if self.mixed:
            metadata["mixed"] = True
        if demonstrates:
            metadata["expert"] = self.expert
        write_trajectories(self.out, runs, metadata)
        unfinished.remove()
        print(f"{self.out}: {len(runs)} runs of {self.task}, seed {self.seed}")
        if experts:
            succeeded = sum(bool(run.scene.metadata["success"]) for run in runs[:experts])
            print(f"the expert succeeded in {succeeded} of {experts} runs")

    def _inputs(self) -> dict[str, Any]:
        """All on which the runs depend; not where they are written, nor by whom."""
        inputs = asdict(self)
        del inputs["out"], inputs["cluster"]
        return inputs
