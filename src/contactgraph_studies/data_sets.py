"""The data sets of the table of results, and the jobs that measure them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum, auto
from functools import cached_property
from importlib.util import find_spec

from contactgraph.envs.registry import task_spec
from contactgraph_studies.job import PLAIN, Job, Measurement, Options, Variant

TRAINING_SEED, TEST_SEED, SCENE_SEED = 0, 1000, 2000
"""Of recorded training trajectories, recorded test trajectories and controlled scenes."""


_MODULES = {
    "pusht": ("gym_pusht",),
    "fetch": ("gymnasium_robotics", "mujoco"),
    "mujoco": ("mujoco",),
}
"""What an extra installs."""


@dataclass(frozen=True)
class Scenes:
    """Scenes that the models of a data set are tested in."""

    slug: str = "as-trained"
    options: Options = ()
    """Options of ``collect`` and ``control``."""
    task: str | None = None
    """A task with another success, in which models are only controlled; None: the data set's."""


@dataclass(frozen=True)
class DataSet:
    """A task as it is recorded; every model is trained on the same trajectories."""

    slug: str
    """Its name for ``--only``, and its folder."""
    options: Options = ()
    """Options of ``collect`` and ``control``."""
    exploration: bool = False
    """Whether half of the episodes have random forces."""
    scenes: tuple[Scenes, ...] = (Scenes(),)
    """Each is a row of the table; the first are those that were trained on."""
    extra: str | None = None
    """The extra that installs what the task needs."""
    hidden: bool = False
    """Whether geometry does not tell its holds: then it is measured under forces, too, and with the
    geometric priors in the place of inference."""

    @property
    def missing(self) -> str | None:
        """One line that says what to install; None if nothing lacks."""
        if self.extra is None or all(map(find_spec, _MODULES[self.extra])):
            return None
        return f"{self.slug} needs another package: pip install 'contactgraph[{self.extra}]'"

    @property
    def controlled(self) -> bool:
        """Whether its task has a control."""
        return not (task_spec(self.slug).passive or "--passive" in self.options)

    def row_name(self, scenes: Scenes) -> str:
        """The label of a row of the table."""
        options = (*self.options, *scenes.options)
        return " ".join((scenes.task or self.slug, *options))


DATA_SETS = (
    DataSet("pickup", scenes=(Scenes(), Scenes("10-distractors", ("--distractors", "10")))),
    DataSet("multi-pickup", scenes=(Scenes(), Scenes("5-picks", ("--objects", "5")))),
    DataSet("door"),
    DataSet("suction", ("--hidden-switch",), hidden=True),
    DataSet("release", hidden=True),
    DataSet("delay", hidden=True),
    DataSet("sticky", hidden=True),
    DataSet("look-alikes", hidden=True),
    DataSet("billiards", ("--passive",)),
    DataSet(
        "pusht",
        scenes=(Scenes(), Scenes("pose", task="pusht-pose")),
        extra="pusht",
    ),
    DataSet("fetch-push", extra="fetch"),
    DataSet("fetch-pick-and-place", exploration=True, extra="fetch"),
    DataSet("unknown-mass"),
    DataSet("chain"),
    DataSet("franka", extra="mujoco"),
    DataSet("toss", extra="mujoco"),
    DataSet("dominoes", extra="mujoco"),
    DataSet("stack", extra="mujoco"),
    DataSet("springs"),
)


@dataclass(frozen=True)
class Amounts:
    """Numbers of trainings, trajectories and episodes."""

    seeds: tuple[int, ...]
    """Of the trainings."""
    training_runs: int
    test_runs: int
    episodes: int
    """Controlled episodes for each training, each in another scene."""
    searched_episodes: int
    """The same of tasks whose starts are searched, and of simulated arms."""
    baselines: bool
    """Whether least squares, a network, scripts and all variants of hidden holds are measured."""
    training_options: Options = ()

    @property
    def quick(self) -> bool:
        """Whether trainings are cut short, so that no number means anything."""
        return bool(self.training_options)

    def episodes_of(self, data: DataSet) -> int:
        """Controlled episodes for each training."""
        slow = task_spec(data.slug).starts or data.slug == "franka"
        return self.searched_episodes if slow else self.episodes


FULL = Amounts((0, 1, 2), 60, 40, 100, 20, baselines=True)
GATE = Amounts((0,), 60, 20, 20, 5, baselines=False)
QUICK = Amounts((0,), 12, 3, 2, 2, baselines=True, training_options=("--steps", "60"))


class Source(StrEnum):
    """The kind of measurement that a number comes from."""

    model = auto()
    """Prediction of recorded trajectories by a model."""
    prior_touch = "prior-touch"
    """The same with the geometric prior in the place of inference: what is near touches."""
    prior_hold = "prior-hold"
    """The same: what is near is held."""
    baselines = auto()
    """Prediction by least squares and a network, fitted for as long as the first training took."""
    forced = auto()
    """Prediction by a model under random constant forces."""
    forced_prior_touch = "forced-prior-touch"
    forced_prior_hold = "forced-prior-hold"
    mpc = auto()
    """Control by MPC with a model."""
    mpc_motion = "mpc-motion"
    """The same without a contact sensor."""
    mpc_prior_touch = "mpc-prior-touch"
    mpc_prior_hold = "mpc-prior-hold"
    expert = auto()
    """Control by the task's expert."""
    fixed_start = "fixed-start"
    """Control without model and search."""


SCRIPTS = (Source.expert, Source.fixed_start)
_PRIORS = (Source.prior_touch, Source.prior_hold)
_VARIANTS = {
    source: Variant(source, "", options)
    for source, options in (
        *((prior, ("--inference", prior)) for prior in _PRIORS),
        (Source.forced, ("--forced",)),
        *((Source(f"forced-{prior}"), ("--forced", "--inference", prior)) for prior in _PRIORS),
        (Source.mpc_motion, ("--unmeasured",)),
        *((Source(f"mpc-{prior}"), ("--inference", prior)) for prior in _PRIORS),
    )
}
"""The further measurements of hidden holds: their options of ``evaluate`` or ``control``."""


@dataclass(frozen=True)
class ResultCondition:
    """The labels of a number in ``results.json``."""

    data: str
    scenes: str
    source: Source


def result_measurements(sets: Sequence[DataSet], amounts: Amounts) -> list[Measurement]:
    """Data set by data set, so that a partial study has whole rows."""
    found: list[Measurement] = []
    for data in sets:
        for seed in amounts.seeds:
            found += _of(data, seed, amounts)
        if amounts.baselines:
            found += _scripts(data, amounts)
    return found


def _scripts(data: DataSet, amounts: Amounts) -> Iterator[Measurement]:
    for scenes in data.scenes if data.controlled else ():
        for source in SCRIPTS:
            task = task_spec(scenes.task or data.slug)
            if source is Source.expert or task.fixed_start is not None:
                output = f"{data.slug}/{source}-{scenes.slug}.json"
                job = _control(data, scenes, amounts, str(source), output)
                yield Measurement(ResultCondition(data.slug, scenes.slug, source), SCENE_SEED, job)


def _of(data: DataSet, seed: int, amounts: Amounts) -> Iterator[Measurement]:
    training = Training(data, seed, amounts)

    def measured(scenes: Scenes, source: Source, job: Job) -> Measurement:
        return Measurement(ResultCondition(data.slug, scenes.slug, source), seed, job)

    for scenes in data.scenes:
        if scenes.task is None:
            yield measured(scenes, Source.model, training.evaluation(scenes))
            if amounts.baselines and seed == amounts.seeds[0]:
                fitted = Variant("baselines", "", ("--baselines", training.data_job.output))
                job = training.evaluation(scenes, fitted, (training.data_job,))
                yield measured(scenes, Source.baselines, job)
        if data.controlled:
            yield measured(scenes, Source.mpc, training.control(scenes))
        for source, variant in _VARIANTS.items() if data.hidden and amounts.baselines else ():
            if source.startswith("mpc"):
                yield measured(scenes, source, training.control(scenes, variant))
            else:
                yield measured(scenes, source, training.evaluation(scenes, variant))


@dataclass(frozen=True)
class Training:
    """A model of a data set."""

    data: DataSet
    seed: int
    amounts: Amounts

    @property
    def folder(self) -> str:
        """Of its files."""
        return f"{self.data.slug}/seed-{self.seed}"

    @cached_property
    def data_job(self) -> Job:
        """The recording of the training data."""
        output = f"{self.data.slug}/train.h5"
        return _collect(self.data, (), self.amounts.training_runs, TRAINING_SEED, output)

    @cached_property
    def job(self) -> Job:
        """The training, by what ``train`` chooses."""
        output = f"{self.folder}/run"
        arguments = ("train", self.data_job.output, "--out", output, "--seed", str(self.seed))
        return Job(
            output,
            (*arguments, *self.amounts.training_options),
            f"train {self.data.slug}",
            (self.data_job,),
            checkpoints="checkpoint-*.safetensors",
        )

    def evaluation(
        self, scenes: Scenes, variant: Variant = PLAIN, needs: tuple[Job, ...] = ()
    ) -> Job:
        """Predictions of recorded trajectories."""
        path = f"{self.data.slug}/test-{scenes.slug}.h5"
        test = _collect(self.data, scenes.options, self.amounts.test_runs, TEST_SEED, path)
        name = "-".join(("evaluate", scenes.slug, *filter(None, [variant.slug])))
        output = f"{self.folder}/{name}.json"
        arguments = ("evaluate", self.job.output, test.output, *variant.options, "--json", output)
        return Job(output, arguments, f"{name} {self.data.slug}", (self.job, test, *needs))

    def control(self, scenes: Scenes, variant: Variant = PLAIN) -> Job:
        """Control by MPC."""
        count = str(self.amounts.episodes_of(self.data))
        name = "-".join(("control", scenes.slug, count, *filter(None, [variant.slug])))
        output = f"{self.folder}/{name}.json"
        job = _control(self.data, scenes, self.amounts, self.job.output, output, (self.job,))
        return replace(job, arguments=(*job.arguments, *variant.options))


def _collect(data: DataSet, options: Options, runs: int, seed: int, output: str) -> Job:
    arguments = (
        *("collect", data.slug, *data.options, *options),
        *(("--exploration", "0.5") if data.exploration else ()),
        *("--episodes", str(runs), "--seed", str(seed), "--out", output),
    )
    return Job(output, arguments, f"collect {data.slug}")


def _control(
    data: DataSet,
    scenes: Scenes,
    amounts: Amounts,
    controller: str,
    output: str,
    needs: tuple[Job, ...] = (),
) -> Job:
    """``controller`` is a model or the name of a scripted policy."""
    arguments = (
        *("control", controller, scenes.task or data.slug, *data.options, *scenes.options),
        *("--episodes", str(amounts.episodes_of(data)), "--seed", str(SCENE_SEED)),
        *("--json", output),
    )
    kind = "mpc" if needs else controller
    return Job(output, arguments, f"control {kind} {data.slug} {scenes.slug}", needs)
