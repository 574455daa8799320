"""Configuration of the study of models: tasks, models, test conditions, amounts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from contactgraph.envs.registry import TaskSpec, TestCondition, task_spec
from contactgraph_studies.job import Options


@dataclass(frozen=True)
class StudyModel:
    """One of the compared models."""

    slug: str
    """Part of folder names."""
    kind: str
    """The paper's name, if it has one."""
    family: str
    """Name of the `Family`."""
    colour: str
    """In all figures."""
    options: Options
    """Options of ``train``."""
    augmented: bool = False
    """Whether it is trained on the augmented data."""
    own_form: bool = False
    """Whether it has the paper's prior, whose d_th a task tells."""

    @property
    def name(self) -> str:
        """With the family, if that is not ours."""
        return f"{self.kind}, {self.family}" if self.own_form else self.kind


@dataclass(frozen=True)
class Family:
    """One form of the models that the paper compares, all trained alike."""

    name: str
    slug: str
    gim_temp: StudyModel
    gim_non_temp: StudyModel
    no_gim: StudyModel
    no_gim_aug: StudyModel
    full_ab: StudyModel
    no_kl: StudyModel

    @property
    def compared(self) -> tuple[StudyModel, ...]:
        """Those in the paper's figure of errors. Full-AB is missing: control cannot use it."""
        return (self.gim_temp, self.gim_non_temp, self.no_gim, self.no_gim_aug)

    @property
    def models(self) -> tuple[StudyModel, ...]:
        """All of them."""
        return (*self.compared, self.full_ab, self.no_kl)


@dataclass(frozen=True)
class StudyTask:
    """One of the paper's tasks."""

    name: str
    augmented_options: Options
    """Options of ``collect`` for the augmented data."""
    prior_distance: str
    """d_th of the authors, m."""
    augmented_runs: int
    """As many as the paper has; the door, for which it gives no number, has as many as pickup."""
    with_samples: bool = False
    """Whether the error is measured by number of training trajectories."""
    training_runs: int = 40
    """Those that models learn from; a quarter as many more choose the best step."""
    only: tuple[StudyModel, ...] = ()
    """Models that are compared on this task; empty: all."""
    planned_options: Options = ()
    """Options of ``control`` if plans are executed for half a second: they must look farther."""
    run_steps: int = 200
    """Length of a whole episode."""
    steps_ahead: int = 10
    """Half a second (the paper's N): horizon of errors, and time between plans."""

    @property
    def models(self) -> tuple[StudyModel, ...]:
        """The compared models."""
        return self.only or tuple(model for family in FAMILIES for model in family.models)

    @property
    def families(self) -> tuple["Family", ...]:
        """Those of which the paper's four models are compared, but for No-GIM-Aug."""
        return tuple(one for one in FAMILIES if set(one.compared[:3]) <= set(self.models))

    @property
    def spec(self) -> TaskSpec:
        """Of the task's class."""
        return task_spec(self.name)

    @property
    def conditions(self) -> tuple[TestCondition, ...]:
        """The one in distribution first, the hardest last."""
        return self.spec.test_conditions(every=False)

    @property
    def as_trained(self) -> TestCondition:
        """Scenes like those of the training data."""
        return self.conditions[0]

    @property
    def hardest(self) -> TestCondition:
        """The scenes that differ most from the training data."""
        return self.conditions[-1]


def families_of(tasks: Sequence[StudyTask]) -> list[Family]:
    """Those that any of the tasks compares, each once."""
    return list(dict.fromkeys(family for task in tasks for family in task.families))


@dataclass(frozen=True)
class Amounts:
    """Numbers of seeds, trajectories and episodes."""

    seeds: tuple[int, ...]
    """Of training data and training."""
    test_runs: int
    """Recorded expert trajectories for each condition."""
    episodes: int
    """Closed-loop episodes for each condition, replanned every half second."""
    success_episodes: int
    """In distribution, of GIM-Temp, replanned every step."""
    long_episodes: int
    """Closed-loop episodes, planned over a whole one."""
    sample_sizes: tuple[int, ...]
    """Numbers of training trajectories."""
    training_options: Options = ()
    """Options of ``train`` for every model of every task."""


TEST_SEED = 1000
"""Of scenes that are in no training data."""

# No-GIM is to do without augmentation, so no bodies are added to its training windows.
_PLAIN = ("--bystanders", "0")


_COLOURS = ("#1b66a8", "#7fb2dd", "#cb5f12", "#eca86f", "#7650a3", "#0d8074")


def _family(
    name: str,
    slug: str,
    models: tuple[str, str, str, str],
    options: Options = (),
    own_form: bool = False,
) -> Family:
    """``models``: the names for ``train`` of GIM-Temp, GIM-Non-Temp, No-GIM and Full-AB."""
    temp, non_temp, no_gim, full_ab = models

    def model(chosen: str, shown_as: str, colour: str, *more: str, slug: str = "") -> StudyModel:
        given = ("--model", chosen, *options, *more)
        return StudyModel(slug or chosen, shown_as, name, colour, given, False, own_form)

    alone = model(no_gim, "No-GIM", _COLOURS[2], *_PLAIN)
    return Family(
        name,
        slug,
        model(temp, "GIM-Temp", _COLOURS[0]),
        model(non_temp, "GIM-Non-Temp", _COLOURS[1]),
        alone,
        replace(
            alone,
            slug=f"{no_gim}-aug",
            kind="No-GIM-Aug",
            colour=_COLOURS[3],
            augmented=True,
        ),
        model(full_ab, "Full-AB", _COLOURS[4]),
        model(
            temp, "GIM-Temp without KL", _COLOURS[5], "--prior-weight", "0", slug=f"{temp}-no-kl"
        ),
    )


def _paper_form(name: str, slug: str, form: str, *trained: str) -> Family:
    """``trained``: with the least held-out error; see the protocol of the claims."""
    models = form, f"{form}-non-temp", f"{form}-no-gim", f"{form}-full-ab"
    return _family(name, slug, models, (*_PLAIN, "--temperature", "1", *trained), own_form=True)


LITERAL = _paper_form(
    *("as written", "literal", "paper-literal", "--event-fraction", "0.1"),
    *("--learning-rate", "1e-3", "--steps", "3000"),
)
CARED_FOR = _paper_form(
    *("cared for", "local", "paper-local", "--event-fraction", "0.5"),
    *("--learning-rate", "3e-4", "--steps", "6000"),
)
_OURS = "ours-recurrent", "ours-memoryless", "ours-no-inference", "ours-full-ab"
OURS = _family("ours", "ours", _OURS)
FAMILIES = (LITERAL, CARED_FOR, OURS)

_3_DISTRACTORS = ("--distractors", "3", "--mixed")
PICKUP = StudyTask(
    "pickup",
    _3_DISTRACTORS,
    "0.1",
    160,
    with_samples=True,
)
MULTI_PICKUP = StudyTask(
    "multi-pickup",
    ("--objects", "3", "--mixed"),
    "0.2",
    120,
)
DOOR = StudyTask("door", _3_DISTRACTORS, "0.085", 160)
FRANKA = StudyTask(
    "franka",
    _3_DISTRACTORS,
    "0.02",
    800,
    training_runs=200,
    # The paper compares the other three. Free matrices and its own form are judged in the plane.
    only=OURS.compared[:3],
    planned_options=("--horizon", "100"),
    run_steps=400,
    steps_ahead=50,
)
TASKS = (PICKUP, MULTI_PICKUP, DOOR)
"""The planar tasks, of which the study of all consists."""
EVERY_TASK = (*TASKS, FRANKA)

FULL = Amounts(
    seeds=(0, 1, 2),
    test_runs=10,
    episodes=20,
    success_episodes=100,
    long_episodes=20,
    sample_sizes=(5, 10, 20, 40, 80, 160),
)
QUICK = Amounts((0,), 5, 10, 10, 2, (10, 40), ("--steps", "300"))
