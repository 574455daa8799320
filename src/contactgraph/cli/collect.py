"""``contactgraph collect``: record trajectories of a task."""

import hashlib
import json
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from contactgraph.cli.options import (
    MOST_EPISODES,
    SceneOptions,
    TaskArgument,
    check_range,
    check_seed,
    given_options,
    open_executor,
    options_metadata,
)
from contactgraph.data import InvalidInputError, Trajectory, read_trajectories, write_trajectories
from contactgraph.data.lookup import choice


@dataclass(frozen=True)
class Collect(SceneOptions):
    """Record trajectories of a task by its scripted expert, and write them to a dataset file.

    The same command continues an interrupted recording.
    """

    task: TaskArgument
    out: Annotated[Path, arg(metavar="FILE")]
    """The file to write (HDF5)."""
    episodes: int = 40
    """Number of episodes."""
    seed: int = 0
    """Random seed; the same seed records the same trajectories."""
    passive: bool = False
    """Nothing is driven: billiards without the cue, whose discs start with velocities; toss,
    dominoes and stack are always so."""
    mixed: bool = False
    """Alternate scenes with 0 to DISTRACTORS distractors, and with 1 to OBJECTS objects."""
    goal: Annotated[str, arg(metavar="NAME")] = "sampled"
    """sampled: a goal and targets for each episode. fixed: the same for all."""
    expert: Annotated[str, arg(metavar="NAME")] = "train"
    """train: with noise on the force, to learn models from. demo: without, to learn costs from."""
    exploration: Annotated[
        float | None, arg(metavar="SHARE", help_behavior_hint="(0.5 with a hidden hold, else 0)")
    ] = None
    """Share of episodes with random forces in place of the expert."""
    resting: float = 0.0
    """Share of episodes without any force."""
    cluster: Annotated[str, arg(metavar="NAME")] = "local"
    """local: a process for each core. ray or ray:HOST:PORT: the machines of a Ray cluster."""

    def run(self) -> None:
        """Record and write."""
        from contactgraph.cli.output import check_writable, progress
        from contactgraph.envs import RestPolicy
        from contactgraph.envs.episodes import collect, fixed_seed
        from contactgraph.envs.registry import task_factory, task_spec

        check_range("--episodes", self.episodes, 1, MOST_EPISODES)
        check_seed(self.seed)
        shared = choice("--goal", self.goal, {"sampled": None, "fixed": fixed_seed(self.seed)})
        options, task = given_options(self), task_spec(self.task)
        if task.passive:
            options.pop("passive", None)  # it always is
        if shared is not None:
            if "fixed_seed" not in task.options:
                raise InvalidInputError(f"--goal fixed: {self.task} has no option fixed_seed")
            options["fixed_seed"] = shared
        task_factory(self.task, options)
        scenes = _mixed(options) if self.mixed else [options]
        factories = [task_factory(self.task, each) for each in scenes]
        demonstrates = choice("--expert", self.expert, {"train": False, "demo": True})
        expert = task.demonstrator if demonstrates else task.expert
        check_range("--resting", self.resting, 0, 1)
        by_default = 0.0 if demonstrates else min(task.exploration, 1.0 - self.resting)
        exploration = by_default if self.exploration is None else self.exploration
        check_range("--exploration", exploration, 0, 1)
        if exploration + self.resting > 1.0:
            raise InvalidInputError("--exploration and --resting together must not exceed 1")
        if demonstrates and exploration + self.resting > 0.0:
            raise InvalidInputError(
                "--expert demo: every episode is a demonstration, so --exploration and --resting "
                "must be left out"
            )
        if self.passive and (demonstrates or exploration > 0.0):
            raise InvalidInputError(
                "--passive: nothing is driven, so --expert demo and --exploration must be left out"
            )
        check_writable(self.out)
        explorations = round(exploration * self.episodes)
        rests = self.episodes if self.passive else round(self.resting * self.episodes)
        experts = self.episodes - explorations - rests
        policies = [expert() for _ in range(experts)]
        policies += [task.explorer() for _ in range(explorations)]
        policies += [RestPolicy() for _ in range(rests)]
        inputs = {key: each for key, each in asdict(self).items() if key not in ("out", "cluster")}
        unfinished = UnfinishedRecording(self.out, inputs)
        if unfinished.recorded:
            done = len(unfinished.recorded)
            print(f"{self.out}: goes on after {done} of {self.episodes} episodes")
        with (
            open_executor(self.cluster) as executor,
            progress("collecting", self.episodes) as bar,
            unfinished.kept_on_failure(),
        ):
            trajectories = collect(
                factories,
                policies,
                self.episodes,
                self.seed,
                on_episode=lambda trajectory: bar.advance(unfinished.add(trajectory)),
                executor=executor,
                recorded=unfinished.recorded,
            )
        metadata = {**options_metadata(options), "task": self.task, "seed": self.seed}
        if self.mixed:
            metadata["mixed"] = True
        if demonstrates:
            metadata["expert"] = self.expert
        simulator = trajectories[0].scene.metadata.get("simulator")
        if simulator is not None:
            metadata["simulator"] = simulator
        write_trajectories(self.out, trajectories, metadata)
        unfinished.remove()
        on = "" if simulator is None else f", on {simulator}"
        print(f"{self.out}: {len(trajectories)} episodes of {self.task}, seed {self.seed}{on}")
        if experts:
            successes = sum(bool(each.scene.metadata["success"]) for each in trajectories[:experts])
            print(f"the expert succeeded in {successes} of {experts} episodes")


def _mixed(options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Options of scenes with 0 to ``distractors`` distractors, and 1 to ``objects`` objects.

    Raises `InvalidInputError` if episodes of one goal were to differ in their objects.
    """
    most, others = options.get("objects"), dict(options)
    if options.get("fixed_seed") is not None and most not in (None, 1):
        raise InvalidInputError(
            "--goal fixed: all episodes have the same objects, so --mixed takes --objects 1 or "
            f"none, found {most}"
        )
    counts = [{}] if most is None else [{"objects": each} for each in range(1, most + 1)]
    distractors = others.pop("distractors", None)
    more = [{}] if distractors is None else [{"distractors": n} for n in range(distractors + 1)]
    return [{**others, **one, **other} for one in counts for other in more]


_SAVE_INTERVAL_S = 10.0
"""Recording time that a killed process may lose."""


class UnfinishedRecording:
    """Trajectories of an interrupted recording, in a folder beside its file ``path``.

    The folder's name depends on everything that shapes the trajectories, so that only the same
    recording continues. It holds files of some trajectories each, named by the index of the first.
    """

    def __init__(self, path: Path, inputs: Mapping[str, Any]) -> None:
        """``inputs``: by name, the JSON values that the trajectories depend on."""
        text = json.dumps({**inputs, "version": version("contactgraph")}, sort_keys=True)
        fingerprint = hashlib.sha256(text.encode()).hexdigest()[:12]
        self.folder = path.with_name(f"{path.name}.unfinished-{fingerprint}")
        self.recorded = self._read()
        """The first trajectories, recorded by an earlier call."""
        self._saved, self._new = len(self.recorded), list[Trajectory]()
        self._saved_s = time.monotonic()

    @contextmanager
    def kept_on_failure(self) -> Iterator[None]:
        """If the block ends with an exception, such as Ctrl-C: saves all trajectories, says so."""
        try:
            yield
        except BaseException:
            self._save()
            if self._saved:
                print(
                    f"{self.folder}: {self._saved} episodes are kept; the same command continues",
                    file=sys.stderr,
                )
            raise

    def add(self, trajectory: Trajectory) -> int:
        """Adds the next trajectory, saved after some seconds; the number that there are now."""
        self._new.append(trajectory)
        if time.monotonic() - self._saved_s >= _SAVE_INTERVAL_S:
            self._save()
        return self._saved + len(self._new)

    def remove(self) -> None:
        """Removes the folder, once the trajectories are in the file."""
        if self.folder.is_dir():
            shutil.rmtree(self.folder)

    def _read(self) -> list[Trajectory]:
        """The saved trajectories up to the first gap or damaged file."""
        trajectories: list[Trajectory] = []
        while (path := self.folder / f"{len(trajectories):06d}.h5").is_file():
            try:
                trajectories.extend(read_trajectories(path))
            except InvalidInputError:
                break
        return trajectories

    def _save(self) -> None:
        if self._new:
            self.folder.mkdir(exist_ok=True)
            write_trajectories(self.folder / f"{self._saved:06d}.h5", self._new)
            self._saved, self._new = self._saved + len(self._new), []
        self._saved_s = time.monotonic()
