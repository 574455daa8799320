"""Tasks by name: of the library, of other packages (entry points), and classes ``module:Class``.

A task is a class. The first line of its docstring is its help, the arguments of its constructor are
its options, and its attributes with the names of the fields of `TaskSpec` say how it is recorded
and controlled. A package adds one by an entry point of the group ``contactgraph.tasks``, which is
imported only when the task is asked for.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from importlib.metadata import entry_points
from numbers import Integral, Real
from types import NoneType
from typing import Any, get_args

from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import choice, load_entry_point, load_object
from contactgraph.envs.contract import Conditions, PolicyFactory, Task
from contactgraph.envs.exploration import ExplorationPolicy, RestPolicy
from contactgraph.envs.planar.world import engine_name

SHIPPED = {
    "pickup": "contactgraph.envs.pickup:PickupTask",
    "multi-pickup": "contactgraph.envs.pickup:MultiPickupTask",
    "door": "contactgraph.envs.door:DoorTask",
    "billiards": "contactgraph.envs.billiards:BilliardsTask",
    "toss": "contactgraph.envs.shaped_tasks:TossTask",
    "dominoes": "contactgraph.envs.shaped_tasks:DominoesTask",
    "stack": "contactgraph.envs.shaped_tasks:StackTask",
    "chain": "contactgraph.envs.chain:ChainTask",
    "unknown-mass": "contactgraph.envs.unknown_mass:UnknownMassTask",
    "springs": "contactgraph.envs.relation_tasks:SpringsTask",
    "suction": "contactgraph.envs.hidden_contact:SuctionTask",
    "release": "contactgraph.envs.hidden_contact:ReleaseTask",
    "delay": "contactgraph.envs.hidden_contact:DelayTask",
    "sticky": "contactgraph.envs.hidden_contact:StickyTask",
    "look-alikes": "contactgraph.envs.hidden_contact:LookAlikesTask",
    "pusht": "contactgraph.envs.pusht:PushTTask",
    "pusht-pose": "contactgraph.envs.pusht:PushTPoseTask",
    "fetch-push": "contactgraph.envs.fetch:FetchPushTask",
    "fetch-slide": "contactgraph.envs.fetch:FetchSlideTask",
    "fetch-pick-and-place": "contactgraph.envs.fetch:FetchPickAndPlaceTask",
}
"""The classes of the library's tasks, which are imported when they are asked for."""

TaskFactory = Callable[[], Task]
_GROUP = "contactgraph.tasks"
_PLAIN = {int: Integral, float: Real, bool: bool, str: str, NoneType: NoneType}


@dataclass(frozen=True)
class TestCondition:
    """Scenes that models are tested in."""

    __test__ = False  # pytest collects every class whose name begins with Test

    name: str
    options: Mapping[str, Any]
    """Of the task."""

    @property
    def slug(self) -> str:
        """Part of file names."""
        return re.sub(r"\W+", "-", self.name)


@dataclass(frozen=True)
class TaskSpec:
    """What the class of a task says of it, all of it optional.

    ``expert``, ``demonstrator``, ``fixed_start`` and ``explorer`` make a `Policy`. By default
    nothing is scripted: random forces are the expert and the explorer, or none where the task is
    `passive`.
    """

    make: Callable[..., Task]
    """The class; its arguments are the options of the task's scenes."""
    expert: PolicyFactory
    """The policy to train on: noise on its force distinguishes mass from damping."""
    demonstrator: PolicyFactory
    """The policy to learn costs from. By default the expert, with ``noise=0.0`` if it takes it."""
    explorer: PolicyFactory
    """The policy of episodes in place of the expert's: see `exploration`."""
    fixed_start: PolicyFactory | None = None
    """The scripted controller without model or search that plans are compared with."""
    exploration: float = 0.0
    """Default share of recorded episodes by the explorer: more than 0 where the expert sees what
    its commands would otherwise tell a model, such as a hidden hold."""
    horizon: int | None = None
    """Default planning horizon, steps. None: by the control."""
    starts: int | None = None
    """Starts that plans are searched from by default. None: by the control."""
    clearance: float | None = None
    """Gap that plans keep by default from bodies that the cost does not name, m."""
    max_force: float | None = None
    """Bound of every component of the control, N. None: there is no common one."""
    passive: bool = False
    """Whether nothing is driven."""
    conditions: Conditions = (("as trained", {}),)
    """Scenes to test in, by name and options: those as trained first, the hardest last."""

    @classmethod
    def of(cls, task: type) -> "TaskSpec":
        """The attributes of a class, with the same defaults for every one."""
        names = {each.name for each in fields(cls)} - {"make"}
        given = {name: getattr(task, name) for name in names if hasattr(task, name)}
        unscripted = RestPolicy if given.get("passive") else ExplorationPolicy
        expert = given.setdefault("expert", unscripted)
        takes_noise = "noise" in inspect.signature(expert).parameters
        exact = partial(expert, noise=0.0) if takes_noise else expert
        return cls(task, **{"demonstrator": exact, "explorer": unscripted, **given})

    @property
    def summary(self) -> str:
        """The first line of the class's docstring, without its full stop."""
        return (self.make.__doc__ or "").strip().partition("\n")[0].removesuffix(".")

    @property
    def options(self) -> Mapping[str, inspect.Parameter]:
        """The arguments of the class by name."""
        try:
            found = inspect.signature(self.make, eval_str=True).parameters
        except NameError:  # an annotation that is imported for type checkers alone
            found = inspect.signature(self.make).parameters
        named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        return {name: each for name, each in found.items() if each.kind in named}

    def test_conditions(self, every: bool = True) -> tuple[TestCondition, ...]:
        """The `conditions`, or the first and the last alone."""
        found = tuple(TestCondition(*each) for each in self.conditions)
        return found if every else (found[0], *found[1:][-1:])


def task_names() -> tuple[str, ...]:
    """The names of all tasks; those of other packages are listed, not imported."""
    others = {entry.name for entry in entry_points(group=_GROUP)} - set(SHIPPED)
    return (*SHIPPED, *sorted(others))


def task_spec(name: str) -> TaskSpec:
    """The task of a name, or of a class named ``module:Class``.

    Raises `InvalidInputError` for an unknown name, and where the class cannot be imported.
    """
    task = load_entry_point(_GROUP, name) if name not in SHIPPED and ":" not in name else None
    if task is None:
        shipped = dict.fromkeys((*task_names(), "module:Class"), "") | SHIPPED
        task = load_object("task", name if ":" in name else choice("task", name, shipped))
    if not inspect.isclass(task):
        raise InvalidInputError(f"task {name}: must be a class, found {task!r}")
    return TaskSpec.of(task)


def task_factory(name: str, options: Mapping[str, Any]) -> TaskFactory:
    """Makes a task with these arguments; the factory can be sent to other processes.

    Raises `InvalidInputError` for an unknown name, and for options that the task does not take.
    """
    spec, given = task_spec(name), dict(options)
    arguments = spec.options
    for option, value in given.items():
        if option not in arguments:
            known = ", ".join(arguments) or "none"
            raise InvalidInputError(f"{option}: {name} has no such option; it has {known}")
        _check_kind(name, option, value, arguments[option].annotation)
    if "engine" in arguments:
        given["engine"] = engine_name(given.get("engine"))
    factory = partial(spec.make, **given)
    factory()  # an invalid count is refused before any work is done
    return factory


def _check_kind(name: str, option: str, value: Any, annotation: Any) -> None:
    """Raises `InvalidInputError` for a value that is not of the annotated numbers or texts."""
    kinds = get_args(annotation) or (annotation,)
    if not all(kind in _PLAIN for kind in kinds):
        return
    fits = isinstance(value, tuple(_PLAIN[kind] for kind in kinds))
    if fits and (bool in kinds or not isinstance(value, bool)):
        return
    wanted = " or ".join(kind.__name__ for kind in kinds if kind is not NoneType)
    raise InvalidInputError(f"{option} of {name} must be of type {wanted}, found {value!r}")


def make(task: str, **options: Any) -> Task:
    """A task by its name, or by that of its class, ``module:Class``.

    ``options`` are arguments of the class. Raises `InvalidInputError` as `task_factory`.
    `contactgraph.make` is this.

    >>> import contactgraph
    >>> task = contactgraph.make("pickup", distractors=2)
    >>> observation, _ = task.reset(seed=0)
    >>> task.scene
    Scene(1 gripper, 3 object; N=4, D=2, dt=0.05 s)
    """
    return task_factory(task, options)()
