"""Configuration of the study of models: tasks, models, test conditions, amounts."""

from dataclasses import dataclass

from contactgraph.cli.known_tasks import TASKS as LIBRARY_TASKS
from contactgraph.cli.task_types import KnownTask, TestCondition
from contactgraph_franka.envs.task_entry import FRANKA as FRANKA_TASK
from contactgraph_studies.job import Options, Variant


@dataclass(frozen=True)
class StudyModel:
    """One of the compared models."""

    slug: str
    """Part of folder names."""
    name: str
    """The paper's, if it has one."""
    colour: str
    """In all figures."""
    options: Options
    """Options of ``train``."""
    augmented: bool = False
    """Whether it is trained on the augmented data."""


@dataclass(frozen=True)
class StudyTask:
    """One of the paper's tasks."""

    name: str
    known: KnownTask
    """Its test conditions and targets."""
    augmented_options: Options
    """Options of ``collect`` for the augmented data."""
    augmented_runs: int
    """As many as the paper has; the door, for which it gives no number, has as many as pickup."""
    with_samples: bool = False
    """Whether the error is measured by number of training trajectories."""
    training_runs: int = 40
    training_options: Options = ()
    """Options of ``train`` for every model."""
    left_out: tuple[StudyModel, ...] = ()
    """Models that are not compared on this task."""
    planned_options: Options = ()
    """Options of ``control`` if plans are executed for half a second: they must look farther."""
    run_steps: int = 200
    """Length of a whole episode."""
    steps_ahead: int = 10
    """Half a second (the paper's N): horizon of errors, and time between plans."""

    @property
    def models(self) -> tuple[StudyModel, ...]:
        """The compared models."""
        return tuple(model for model in MODELS if model not in self.left_out)

    @property
    def conditions(self) -> tuple[TestCondition, ...]:
        """The one in distribution first, the hardest last."""
        return self.known.conditions

    @property
    def as_trained(self) -> TestCondition:
        """Scenes like those of the training data."""
        return self.conditions[0]

    @property
    def hardest(self) -> TestCondition:
        """The scenes that differ most from the training data."""
        return self.conditions[-1]


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
    """Of GIM-Temp, replanned every step."""
    sample_sizes: tuple[int, ...]
    """Numbers of training trajectories."""
    extras: bool
    """Whether conditions marked as extra are measured."""
    training_options: Options = ()
    """Options of ``train`` for every model of every task."""


TEST_SEED = 1000
"""Of scenes that are in no training data."""

# No-GIM is to do without augmentation, so no bodies are added to its training windows.
_PLAIN = ("--bystanders", "0")
GIM_TEMP = StudyModel("gim-temp", "GIM-Temp", "#1b66a8", ("--model", "gim-temp"))
GIM_NON_TEMP = StudyModel("gim-non-temp", "GIM-Non-Temp", "#7fb2dd", ("--model", "gim-non-temp"))
NO_GIM = StudyModel("no-gim", "No-GIM", "#cb5f12", ("--model", "no-gim", *_PLAIN))
NO_GIM_AUG = StudyModel("no-gim-aug", "No-GIM-Aug", "#eca86f", NO_GIM.options, augmented=True)
FULL_AB = StudyModel("full-ab", "Full-AB", "#7650a3", ("--model", "full-ab"))
_NO_PRIOR = ("--model", "gim-temp", "--prior-weight", "0")
NO_KL = StudyModel("gim-temp-no-kl", "GIM-Temp without KL", "#0d8074", _NO_PRIOR)
_LITERAL = ("--model", "paper-literal", *_PLAIN)
LITERAL = StudyModel("paper-literal", "paper-literal", "#a5a9ae", _LITERAL)
_LITERAL_NO_GIM = ("--model", "paper-literal-no-gim", *_PLAIN)
LITERAL_NO_GIM = StudyModel(
    "paper-literal-no-gim", "paper-literal No-GIM", "#6d7278", _LITERAL_NO_GIM
)
MODELS = (GIM_TEMP, GIM_NON_TEMP, NO_GIM, NO_GIM_AUG, FULL_AB, NO_KL, LITERAL, LITERAL_NO_GIM)

_3_DISTRACTORS = ("--distractors", "3", "--mixed")
PICKUP = StudyTask("pickup", LIBRARY_TASKS["pickup"], _3_DISTRACTORS, 160, with_samples=True)
MULTI_PICKUP = StudyTask(
    "multi-pickup",
    LIBRARY_TASKS["multi-pickup"],
    ("--objects", "3", "--mixed"),
    120,
    with_samples=True,
)
DOOR = StudyTask("door", LIBRARY_TASKS["door"], _3_DISTRACTORS, 160)
FRANKA = StudyTask(
    "franka",
    FRANKA_TASK,
    _3_DISTRACTORS,
    800,
    training_runs=200,
    # The paper compares the other three. Free matrices and its own form are judged in the plane.
    left_out=(NO_GIM_AUG, FULL_AB, NO_KL, LITERAL, LITERAL_NO_GIM),
    planned_options=("--horizon", "100"),
    run_steps=400,
    steps_ahead=50,
)
TASKS = (PICKUP, MULTI_PICKUP, DOOR)
"""The planar tasks, of which the study of all consists."""
EVERY_TASK = (*TASKS, FRANKA)

_RATES = {1: "0.01", 5: "0.05", 20: "0.2"}
FAULTS = (
    *(
        Variant(f"{kind}-{percent}", f"{percent} % {name}", (f"--{kind}", rate))
        for kind, name in (("false-alarms", "false alarms"), ("misses", "misses"))
        for percent, rate in _RATES.items()
    ),
    Variant("delay-1", "one step late", ("--delay", "1")),
    Variant("delay-2", "two steps late", ("--delay", "2")),
)

FULL = Amounts((0, 1, 2), 20, 20, 100, (5, 10, 20, 40, 80, 160), extras=True)
QUICK = Amounts((0,), 5, 5, 10, (10, 40, 160), extras=False)
