"""The tasks of the study of worlds, and the jobs that measure them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum, auto
from functools import cached_property
from importlib.util import find_spec

from contactgraph.cli.known_tasks import TASKS
from contactgraph.cli.task_types import TestCondition
from contactgraph.cli.tasks import known_task
from contactgraph_franka.envs.task_entry import FRANKA
from contactgraph_studies.job import PLAIN, Job, Measurement, Options, Variant

TEST_SEED, SCENE_SEED = 1000, 2000
"""Of recorded test trajectories and of controlled scenes; no training data have either."""

_AS_TRAINED = TestCondition("as-trained", "as trained", True)


@dataclass(frozen=True)
class World:
    """A task as it is recorded; for each seed one model is trained on it."""

    slug: str
    """Its name for ``--only``, and its folder."""
    task: str
    options: Options = ()
    """Options of ``collect`` and ``control``."""
    recording: Options = ()
    """Further options of ``collect``."""
    scenes: tuple[TestCondition, ...] = (_AS_TRAINED,)
    """Each is a row of the table."""
    extra: str | None = None
    """The extra that installs `packages`."""
    packages: tuple[str, ...] = ()
    """Modules that the task needs."""
    fast_control: bool = False
    """Whether more episodes are controlled."""
    controlled: bool = True
    shipped_runs: int | None = None
    """Trajectories, of seed 0, that the shipped model was trained on; None: models are trained."""

    @property
    def missing(self) -> str | None:
        """One line that says what to install; None if nothing lacks."""
        if all(find_spec(package) is not None for package in self.packages):
            return None
        return f"{self.slug} needs another package: pip install 'contactgraph[{self.extra}]'"

    @property
    def has_fixed_start(self) -> bool:
        """Whether the task has a controller without model and search."""
        return known_task(self.task).fixed_start is not None

    def row_name(self, scenes: TestCondition) -> str:
        """The label of a row of the table."""
        name = f"{self.task} {' '.join(self.options)}".strip()
        name = name if len(self.scenes) == 1 else f"{name}, {scenes.name}"
        return f"{name} (shipped model)" if self.shipped_runs else name


def _first_and_hardest(task: str) -> tuple[TestCondition, TestCondition]:
    return TASKS[task].conditions[0], TASKS[task].conditions[-1]


_EXPLORED = ("--exploration", "0.5")
"""Of all tasks but the paper's: an expert alone touches in one way only."""

_PUSHT = ("gym_pusht",)
_FETCH = ("gymnasium_robotics", "mujoco")
WORLDS = (
    *(
        World(task, task, scenes=_first_and_hardest(task), fast_control=True)
        for task in ("pickup", "multi-pickup", "door")
    ),
    World("suction", "suction", recording=_EXPLORED),
    World("suction-hidden", "suction", ("--hidden-switch",), _EXPLORED),
    *(
        World(task, task, recording=_EXPLORED)
        for task in ("release", "delay", "sticky", "billiards")
    ),
    World("billiards-passive", "billiards", ("--passive",), controlled=False),
    World("pusht", "pusht", recording=_EXPLORED, extra="pusht", packages=_PUSHT),
    *(
        World(task, task, recording=_EXPLORED, extra="fetch", packages=_FETCH)
        for task in ("fetch-push", "fetch-slide", "fetch-pick-and-place")
    ),
    World(
        "franka",
        "franka",
        scenes=FRANKA.conditions[:1],
        extra="mujoco",
        packages=("mujoco",),
        shipped_runs=200,
    ),
)


@dataclass(frozen=True)
class WorldAmounts:
    """Numbers of seeds, trajectories and episodes."""

    seeds: tuple[int, ...]
    """Of training data and training."""
    training_runs: int
    test_runs: int
    """For each row."""
    episodes: int
    fast_episodes: int
    """Of tasks with `World.fast_control`."""
    folder: str
    """Of the jobs' outputs; a quick study leaves those of the full one alone."""
    training_options: Options = ()

    @property
    def quick(self) -> bool:
        """Whether trainings are cut short, so that no number means anything."""
        return bool(self.training_options)

    def seeds_of(self, world: World) -> tuple[int, ...]:
        """Of the world's trainings."""
        return (0,) if world.shipped_runs else self.seeds

    def episodes_of(self, world: World) -> int:
        """Controlled episodes for each training, each in another scene."""
        return self.fast_episodes if world.fast_control else self.episodes


FULL_WORLDS = WorldAmounts((0, 1, 2), 60, 40, 20, 100, "cells")
QUICK_WORLDS = WorldAmounts((0,), 12, 3, 2, 2, "cells/quick", ("--steps", "60"))


class Source(StrEnum):
    """The kind of measurement that a number comes from."""

    open_loop = auto()
    """Prediction of recorded trajectories."""
    mpc = auto()
    """Control by MPC with the model."""
    scripted = auto()
    """Control by the task's expert."""
    fixed_start = auto()
    """Control without model and search, the same in every scene."""


@dataclass(frozen=True)
class WorldCondition:
    """The labels of a number in ``results.json``."""

    world: str
    scenes: str
    source: Source


def world_measurements(worlds: Sequence[World], amounts: WorldAmounts) -> list[Measurement]:
    """World by world, so that a partial study has whole rows."""
    return [one for world in worlds for one in _of(world, amounts)]


def _of(world: World, amounts: WorldAmounts) -> Iterator[Measurement]:
    for seed in amounts.seeds_of(world):
        for scenes in world.scenes:
            training = WorldTraining(world, seed, amounts)
            yield Measurement(
                WorldCondition(world.slug, scenes.slug, Source.open_loop),
                seed,
                training.evaluation(scenes, beside_baselines=True),
            )
            if world.controlled:
                condition = WorldCondition(world.slug, scenes.slug, Source.mpc)
                yield Measurement(condition, seed, training.control(scenes))
    sources = {"expert": Source.scripted, "fixed-start": Source.fixed_start}
    for scenes in world.scenes if world.controlled else ():
        for policy, source in sources.items():
            if policy == "expert" or world.has_fixed_start:
                output = f"{amounts.folder}/{world.slug}/{policy}-{scenes.slug}.json"
                job = _control(world, scenes, amounts, policy, output)
                yield Measurement(WorldCondition(world.slug, scenes.slug, source), SCENE_SEED, job)


@dataclass(frozen=True)
class WorldTraining:
    """A model of a world, its training and its evaluation."""

    world: World
    seed: int
    amounts: WorldAmounts
    variant: Variant = PLAIN
    """Further options of ``train``."""

    @property
    def folder(self) -> str:
        """Of its files."""
        return f"{self.amounts.folder}/{self.world.slug}/seed-{self.seed}"

    @property
    def model(self) -> str:
        """Its run folder, or the name of a shipped model."""
        return self.world.task if self.job is None else self.job.output

    @cached_property
    def data(self) -> Job:
        """The training data; of a shipped model those that it was trained on."""
        runs = self.amounts.training_runs
        if self.world.shipped_runs and not self.amounts.quick:
            runs = self.world.shipped_runs
        return _collect(self.world, (), runs, self.seed, f"{self.folder}/train.h5")

    @cached_property
    def job(self) -> Job | None:
        """The training; None for a shipped model."""
        if self.world.shipped_runs:
            return None
        output = f"{self.folder}/{_named('run', self.variant)}"
        arguments = ("train", self.data.output, "--out", output, "--seed", str(self.seed))
        return Job(
            output,
            (*arguments, *self.variant.options, *self.amounts.training_options),
            _named(f"train {self.world.slug}", self.variant),
            (self.data,),
            checkpoints="checkpoint-*.safetensors",
        )

    @property
    def _inputs(self) -> tuple[Job, ...]:
        return () if self.job is None else (self.job,)

    def evaluation(
        self, scenes: TestCondition, variant: Variant = PLAIN, beside_baselines: bool = False
    ) -> Job:
        """Predictions of recorded trajectories; ``beside_baselines`` fits these, too."""
        world, amounts = self.world, self.amounts
        path = f"{amounts.folder}/{world.slug}/test-{scenes.slug}.h5"
        test = _collect(world, scenes.options, amounts.test_runs, TEST_SEED, path)
        name = _named(f"evaluate-{scenes.slug}", self.variant, variant)
        output = f"{self.folder}/{name}.json"
        baselines = ("--baselines", self.data.output) if beside_baselines else ()
        arguments = (
            *("evaluate", self.model, test.output, *baselines, *variant.options),
            *("--infer-contacts", "--json", output),
        )
        data = (self.data, test) if beside_baselines else (test,)
        group = _named(f"evaluate {world.slug} {scenes.slug}", self.variant, variant)
        return Job(output, arguments, group, (*self._inputs, *data))

    def control(self, scenes: TestCondition, variant: Variant = PLAIN) -> Job:
        """Control by MPC."""
        output = f"{self.folder}/{_named(f'control-{scenes.slug}', self.variant, variant)}.json"
        return _control(self.world, scenes, self.amounts, self.model, output, self._inputs, variant)


def _named(name: str, *variants: Variant) -> str:
    return "-".join([name, *(one.slug for one in variants if one.slug)])


def _collect(world: World, options: Options, runs: int, seed: int, output: str) -> Job:
    arguments = (
        *("collect", world.task, *world.options, *options, *world.recording),
        *("--episodes", str(runs), "--seed", str(seed), "--out", output),
    )
    return Job(output, arguments, f"collect {world.slug}")


def _control(
    world: World,
    scenes: TestCondition,
    amounts: WorldAmounts,
    controller: str,
    output: str,
    needs: tuple[Job, ...] = (),
    variant: Variant = PLAIN,
) -> Job:
    """``controller`` is a model or the name of a scripted policy."""
    arguments = (
        *("control", controller, world.task, *world.options, *scenes.options, *variant.options),
        *("--episodes", str(amounts.episodes_of(world)), "--seed", str(SCENE_SEED)),
        *("--json", output),
    )
    kind = "mpc" if needs or world.shipped_runs else controller
    group = _named(f"control {kind} {world.slug} {scenes.slug}", variant)
    return Job(output, arguments, group, needs)
