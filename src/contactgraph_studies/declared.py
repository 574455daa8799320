"""What the paper's study measures: tasks, models, test conditions, and how much of each."""

from dataclasses import dataclass

from contactgraph.cli.tasks import TASKS as LIBRARY_TASKS
from contactgraph.cli.tasks import TestCondition as TestCondition
from contactgraph_franka.envs.task_entry import FRANKA as FRANKA_TASK

Options = tuple[str, ...]
"""Of a command, as a user types them."""


@dataclass(frozen=True)
class StudyModel:
    """One of the models that are compared."""

    slug: str
    """Names folders."""
    name: str
    """The paper's, where it has one."""
    options: Options
    """Of ``train``."""
    augmented: bool = False
    """Whether it is trained on the augmented data."""


@dataclass(frozen=True)
class StudyTask:
    """One of the paper's tasks."""

    name: str
    conditions: tuple[TestCondition, ...]
    """The one in distribution first, the hardest last."""
    augmented_options: Options
    """Of ``collect``, for the augmented data."""
    augmented_runs: int
    """As many as the paper has; for the door, which the paper names no number for, as pickup."""
    with_samples: bool
    """Whether error is measured against the number of training runs."""
    training_runs: int = 40
    training_options: Options = ()
    """Of ``train``, for every model."""
    left_out: tuple[str, ...] = ()
    """Slugs of models that are not compared on this task."""
    followed_options: Options = ()
    """Of ``control``, where plans are followed for half a second: they must look farther."""
    run_steps: int = 200
    """Of a whole run, over which predictions may grow, and plans may reach."""
    steps_ahead: int = 10
    """In half a second (the paper's N): how far ahead errors look, how long plans are followed."""

    @property
    def models(self) -> tuple[StudyModel, ...]:
        """Those that are compared."""
        return tuple(model for model in MODELS if model.slug not in self.left_out)

    @property
    def as_trained(self) -> TestCondition:
        """Scenes like those of the training data."""
        return self.conditions[0]

    @property
    def hardest(self) -> TestCondition:
        """The scenes furthest from those of the training data."""
        return self.conditions[-1]


@dataclass(frozen=True)
class SensorFault:
    """A contact sensor that is wrong in a known way."""

    slug: str
    name: str
    options: Options
    """Of ``evaluate``."""


@dataclass(frozen=True)
class Amounts:
    """How much of everything."""

    seeds: tuple[int, ...]
    """Of training data and training."""
    test_runs: int
    """Recorded expert runs a condition."""
    episodes: int
    """Closed-loop episodes a condition, planned anew every half second."""
    success_episodes: int
    """Of GIM-Temp, planned anew every step."""
    sample_sizes: tuple[int, ...]
    """Training runs."""
    extras: bool
    """Whether conditions marked as extra are measured."""
    training_options: Options = ()
    """Of ``train``, for every model of every task."""


TEST_SEED = 1000
"""Of scenes that no training has seen."""
HORIZON_S = 0.5
"""How far ahead errors look, s (the paper's N steps)."""

GIM_TEMP = StudyModel("gim-temp", "GIM-Temp", ("--model", "gim-temp"))
GIM_NON_TEMP = StudyModel("gim-non-temp", "GIM-Non-Temp", ("--model", "gim-non-temp"))
# Bodies put into the windows would be augmented data, which these two are there to do without.
NO_GIM = StudyModel("no-gim", "No-GIM", ("--model", "no-gim", "--bystanders", "0"))
NO_GIM_AUG = StudyModel("no-gim-aug", "No-GIM-Aug", NO_GIM.options, augmented=True)
FULL_AB = StudyModel("full-ab", "Full-AB", ("--model", "full-ab"))
NO_KL = StudyModel(
    "gim-temp-no-kl", "GIM-Temp without KL", ("--model", "gim-temp", "--prior-weight", "0")
)
LITERAL = StudyModel(
    "paper-literal", "paper-literal", ("--model", "paper-literal", "--bystanders", "0")
)
LITERAL_NO_GIM = StudyModel(
    "paper-literal-no-gim",
    "paper-literal No-GIM",
    ("--model", "paper-literal-no-gim", "--bystanders", "0"),
)
MODELS = (GIM_TEMP, GIM_NON_TEMP, NO_GIM, NO_GIM_AUG, FULL_AB, NO_KL, LITERAL, LITERAL_NO_GIM)

PICKUP = StudyTask(
    "pickup",
    LIBRARY_TASKS["pickup"].conditions,
    ("--distractors", "3", "--mixed"),
    augmented_runs=160,
    with_samples=True,
)
MULTI_PICKUP = StudyTask(
    "multi-pickup",
    LIBRARY_TASKS["multi-pickup"].conditions,
    ("--objects", "3", "--mixed"),
    augmented_runs=120,
    with_samples=True,
)
DOOR = StudyTask(
    "door",
    LIBRARY_TASKS["door"].conditions,
    ("--distractors", "3", "--mixed"),
    augmented_runs=160,
    with_samples=False,
)
FRANKA = StudyTask(
    "franka",
    FRANKA_TASK.conditions,
    ("--distractors", "3", "--mixed"),
    augmented_runs=800,
    with_samples=False,
    training_runs=200,
    # The paper compares the other three; free matrices and its own form are judged in the plane.
    left_out=(
        *(NO_GIM_AUG.slug, FULL_AB.slug, NO_KL.slug),
        *(LITERAL.slug, LITERAL_NO_GIM.slug),
    ),
    followed_options=("--horizon", "100"),
    run_steps=400,
    steps_ahead=50,
)
TASKS = (PICKUP, MULTI_PICKUP, DOOR)
"""In the plane: what a study of all is of."""
EVERY_TASK = (*TASKS, FRANKA)

FAULTS = (
    *(
        SensorFault(
            f"false-alarms-{percent}", f"{percent} % false alarms", ("--false-alarms", rate)
        )
        for percent, rate in ((1, "0.01"), (5, "0.05"), (20, "0.2"))
    ),
    *(
        SensorFault(f"misses-{percent}", f"{percent} % misses", ("--misses", rate))
        for percent, rate in ((1, "0.01"), (5, "0.05"), (20, "0.2"))
    ),
    SensorFault("delay-1", "one step late", ("--delay", "1")),
    SensorFault("delay-2", "two steps late", ("--delay", "2")),
)

FULL = Amounts((0, 1, 2), 20, 20, 100, (5, 10, 20, 40, 80, 160), extras=True)
QUICK = Amounts((0,), 5, 5, 10, (10, 40, 160), extras=False)
