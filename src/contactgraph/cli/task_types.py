"""The entry of a task: options of its scenes, factory, policies and test conditions."""

from collections.abc import Callable
from dataclasses import dataclass

from contactgraph.data import InvalidInputError
from contactgraph.envs import ExplorationPolicy
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.gripper_task import MAX_FORCE


@dataclass(frozen=True)
class TaskOptions:
    """Options of a task's scenes, as given on the command line. None: the task's default."""

    distractors: int = 0
    objects: int | None = None
    grasp: str | None = None
    fixed_seed: int | None = None
    """Seed of the scene whose targets and goal all episodes share."""
    radius: float | None = None
    """Radius of every body, m."""
    passive: bool = False
    """Whether nothing is driven, so that the control is empty."""
    hidden_switch: bool = False
    """Whether a random process, which nothing records, operates the gripper's switch."""
    lose_grasp: float = 0.0
    """Share of the episodes in which a grasp is lost on the way."""
    in_the_way: bool = False
    """Whether a straight way touches two distractors or more."""
    engine: str | None = None
    """Physics engine of a planar task."""

    @property
    def metadata(self) -> dict[str, str | int | float]:
        """The given options, for the metadata of written files."""
        goal = None if self.fixed_seed is None else "fixed"
        names = ("objects", "grasp", "goal", "radius")
        options = zip(names, (self.objects, self.grasp, goal, self.radius), strict=True)
        given = {name: value for name, value in options if value is not None}
        if self.passive:
            given["passive"] = True
        if self.hidden_switch:
            given["hidden_switch"] = True
        if self.lose_grasp:
            given["lose_grasp"] = self.lose_grasp
        if self.in_the_way:
            given["in_the_way"] = True
        return {"distractors": self.distractors, **given}


@dataclass(frozen=True)
class TestCondition:
    """Scenes that models are tested in."""

    __test__ = False  # pytest collects every class whose name begins with Test

    slug: str
    """Part of file names."""
    name: str
    in_distribution: bool
    """Whether models are trained on such scenes."""
    distractors: int = 0
    objects: int | None = None
    """None: the task's default."""
    extra: bool = False
    """Whether a quick study leaves the condition out."""

    @property
    def options(self) -> tuple[str, ...]:
        """The options of ``collect`` and ``control`` for these scenes."""
        distractors = ("--distractors", str(self.distractors)) if self.distractors else ()
        objects = () if self.objects is None else ("--objects", str(self.objects))
        return (*distractors, *objects)


TaskFactory = Callable[[], Task]


@dataclass(frozen=True)
class KnownTask:
    """A task that has a name on the command line."""

    factory: Callable[[TaskOptions], TaskFactory]
    expert: Callable[[], Policy]
    """Makes the policy to train on: noise on its force distinguishes mass from damping."""
    demonstrator: Callable[[], Policy]
    """Makes the same policy without noise."""
    fixed_start: Callable[[], Policy] | None = None
    """Makes the scripted controller without model or search that plans are compared with."""
    explorer: Callable[[], Policy] = ExplorationPolicy
    horizon: int = 20
    """Default planning horizon, steps."""
    starts: int = 0
    """Starts that plans are searched from by default; where what is touched is held, iLQR needs
    none."""
    max_force: float | None = MAX_FORCE
    """Bound of the control on each axis, N."""
    passive: bool = False
    """Whether it moves without a control, or can."""
    summary: str = ""
    """One line for the list of tasks."""
    title: str = "A contact graph learned from recorded trajectories"
    """Title of the report page."""
    conditions: tuple[TestCondition, ...] = (TestCondition("as-trained", "as trained", True),)
    """Test conditions: the one in distribution first, the hardest last."""


def refuse_option(task: str, flag: str, value: object, reason: str) -> None:
    """Raises `InvalidInputError` where an option that the task does not take is given."""
    if value is not None:
        raise InvalidInputError(f"{flag}: {task} {reason}, found {value!r}")


def without_options(
    name: str, make: Callable[[], Task], reason: str, options: TaskOptions
) -> TaskFactory:
    """The factory of a task without options; raises `InvalidInputError` where one is given."""
    refuse_option(name, "--distractors", options.distractors or None, reason)
    refuse_option(name, "--objects", options.objects, reason)
    refuse_option(name, "--grasp", options.grasp, reason)
    refuse_option(name, "--goal fixed", options.fixed_seed, reason)
    return make
