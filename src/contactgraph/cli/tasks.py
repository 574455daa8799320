"""Tasks by name: those of the library, of other packages (entry points), or ``module:Class``.

A package adds a `KnownTask` by an entry point of the group ``contactgraph.tasks``, which is
imported only when the task is asked for. JAX is not needed to record trajectories.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from contactgraph.cli.options import choice, load_entry_point, load_object
from contactgraph.data import InvalidInputError
from contactgraph.envs import (
    DoorExpert,
    DoorTask,
    ExplorationPolicy,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
)
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.gripper_task import MAX_FORCE

_GROUP = "contactgraph.tasks"


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

    @property
    def metadata(self) -> dict[str, str | int | float]:
        """The given options, for the metadata of written files."""
        goal = None if self.fixed_seed is None else "fixed"
        names = ("objects", "grasp", "goal", "radius")
        options = zip(names, (self.objects, self.grasp, goal, self.radius), strict=True)
        given = {name: value for name, value in options if value is not None}
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


@dataclass(frozen=True)
class Target:
    """Required and desired value of one measured number."""

    at_least: float
    aim: float | None = None


TargetByScene = dict[bool, Target]
"""The target of a number by whether the scenes are like those of training."""


@dataclass(frozen=True)
class TaskTargets:
    """Targets of the numbers that are measured on one task."""

    error_cm: TargetByScene = field(default_factory=dict)
    """Of the N-step error."""
    edge_f1: TargetByScene = field(default_factory=dict)
    success_percent: TargetByScene = field(default_factory=dict)
    contact_speed: Target | None = None
    """Median, m/s."""
    training_s: Target | None = None
    tick_ms: Target | None = None
    """99 % of the control steps, in the hardest scenes."""


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
    max_force: float | None = MAX_FORCE
    """Bound of the control on each axis, N."""
    summary: str = ""
    """One line for the list of tasks."""
    title: str = "A contact graph learned from recorded trajectories"
    """Title of the report page."""
    conditions: tuple[TestCondition, ...] = (TestCondition("as-trained", "as trained", True),)
    """Test conditions: the one in distribution first, the hardest last."""
    targets: TaskTargets = TaskTargets()

    def error_target_cm(self, condition: TestCondition) -> Target | None:
        """Target of the N-step error; None for conditions without one."""
        if condition not in (self.conditions[0], self.conditions[-1]):
            return None
        return self.targets.error_cm.get(condition.in_distribution)


def _refuse(task: str, flag: str, value: object, reason: str) -> None:
    if value is not None:
        raise InvalidInputError(f"{flag}: {task} {reason}, found {value!r}")


def _pickup(options: TaskOptions) -> TaskFactory:
    _refuse("pickup", "--grasp", options.grasp, "has no fingers to close")
    if options.objects != 1:
        _refuse("pickup", "--objects", options.objects, "has 1 object")
    task = partial(PickupTask, options.distractors, fixed_seed=options.fixed_seed)
    return task if options.radius is None else partial(task, radius=options.radius)


def _multi_pickup(options: TaskOptions) -> TaskFactory:
    _refuse("multi-pickup", "--grasp", options.grasp, "has no fingers to close")
    task = MultiPickupTask if options.objects is None else partial(MultiPickupTask, options.objects)
    return partial(task, distractors=options.distractors, fixed_seed=options.fixed_seed)


def _door(options: TaskOptions) -> TaskFactory:
    _refuse("door", "--grasp", options.grasp, "has no fingers to close")
    _refuse("door", "--objects", options.objects, "has no objects to count")
    return partial(DoorTask, options.distractors, fixed_seed=options.fixed_seed)


def _planar_targets(error_cm: Target, error_cm_elsewhere: Target) -> TaskTargets:
    return TaskTargets(
        error_cm={True: error_cm, False: error_cm_elsewhere},
        edge_f1={True: Target(0.97, 0.995), False: Target(0.95, 0.995)},
        success_percent={True: Target(98.0, 100.0), False: Target(95.0, 100.0)},
        contact_speed=Target(0.3),
        training_s=Target(120.0, 30.0),
        tick_ms=Target(10.0, 3.0),
    )


TASKS = {
    "pickup": KnownTask(
        _pickup,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up an object and takes it to a goal",
        title="A contact graph that picks things up",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("3-distractors", "3 distractors", False, distractors=3, extra=True),
            TestCondition("10-distractors", "10 distractors", False, distractors=10),
        ),
        targets=_planar_targets(Target(0.4, 0.2), Target(0.3, 0.1)),
    ),
    "multi-pickup": KnownTask(
        _multi_pickup,
        PickupExpert,
        partial(PickupExpert, noise=0.0),
        summary="a gripper picks up objects in turn and takes them to a goal",
        title="A contact graph that picks up one thing after another",
        conditions=(
            TestCondition("as-trained", "as trained, 2 picks", True),
            TestCondition("5-picks", "5 picks", False, objects=5),
        ),
        targets=_planar_targets(Target(1.0, 0.3), Target(1.5, 0.5)),
    ),
    "door": KnownTask(
        _door,
        DoorExpert,
        partial(DoorExpert, noise=0.0),
        summary="a gripper opens a hinged door to an angle",
        title="A contact graph that opens doors",
        conditions=(
            TestCondition("as-trained", "as trained", True),
            TestCondition("10-doors", "10 more doors", False, distractors=10),
        ),
        targets=_planar_targets(Target(1.0, 0.3), Target(1.2, 0.3)),
    ),
}


def task_names() -> tuple[str, ...]:
    """The names of all tasks; those of other packages are listed, not imported."""
    return (*TASKS, *sorted({entry.name for entry in entry_points(group=_GROUP)} - set(TASKS)))


def known_task(name: str) -> KnownTask:
    """The task of a name, or of a class named ``module:Class``.

    Raises `InvalidInputError` for an unknown name, and where the class cannot be imported.
    """
    if name in TASKS:
        return TASKS[name]
    if ":" in name:
        return _task_of_class(name)
    names = (*task_names(), "module:Class")
    task = load_entry_point(_GROUP, name, KnownTask)
    return task or choice("task", name, dict.fromkeys(names, TASKS["pickup"]))


def _task_of_class(name: str) -> KnownTask:
    """The task of a class; its attribute ``expert`` makes the policy that is recorded."""
    loaded = load_object("task", name)
    if not inspect.isclass(loaded):
        raise InvalidInputError(f"task {name}: must be a class, found {loaded!r}")
    task_class: Any = loaded
    expert = getattr(task_class, "expert", ExplorationPolicy)
    return KnownTask(
        partial(_factory_of_class, name, task_class),
        expert,
        getattr(task_class, "demonstrator", expert),
        getattr(task_class, "fixed_start", None),
        horizon=getattr(task_class, "horizon", 20),
        max_force=None,
    )


def _factory_of_class(
    name: str, task_class: Callable[..., Task], options: TaskOptions
) -> TaskFactory:
    """Calls the class with the given options that its constructor takes, by name."""
    parameters = inspect.signature(task_class).parameters
    given: dict[str, Any] = {
        "distractors": options.distractors or None,
        "objects": options.objects,
        "grasp": options.grasp,
        "fixed_seed": options.fixed_seed,
        "radius": options.radius,
    }
    given = {key: value for key, value in given.items() if value is not None}
    for key, value in given.items():
        if key not in parameters:
            flag, found = (f"--{key}", value) if key != "fixed_seed" else ("--goal", "fixed")
            _refuse(name, flag, found, f"takes no argument {key!r}")
    return partial(task_class, **given)


def task_factory(name: str, options: TaskOptions) -> TaskFactory:
    """Makes a task's environment; the factory can be sent to other processes.

    Raises `InvalidInputError` for an unknown name, and for options that the task does not take.
    """
    if options.radius is not None and name != "pickup" and ":" not in name:
        known_task(name)
        raise InvalidInputError(f"--radius: only pickup has bodies of another size, found {name}")
    factory = known_task(name).factory(options)
    factory()  # an invalid count is refused before any work is done
    return factory


def mixed_factories(name: str, options: TaskOptions) -> list[TaskFactory]:
    """A task's environments with 0 to ``distractors`` distractors, and 1 to ``objects`` objects.

    Raises as `task_factory`, and if episodes of one goal were to differ in their objects.
    """
    task_factory(name, options)
    if options.fixed_seed is not None and options.objects not in (None, 1):
        raise InvalidInputError(
            "--goal fixed: all episodes have the same objects, so --mixed takes --objects 1 or "
            f"none, found {options.objects}"
        )
    counts = [None] if options.objects is None else range(1, options.objects + 1)
    return [
        task_factory(name, replace(options, distractors=distractors, objects=objects))
        for objects in counts
        for distractors in range(options.distractors + 1)
    ]
