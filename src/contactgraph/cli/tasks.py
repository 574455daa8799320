"""Tasks and their experts by the names a user types. JAX is not needed to record runs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from contactgraph.cli.options import choice
from contactgraph.data import InvalidInputError
from contactgraph.envs import (
    DoorExpert,
    DoorTask,
    ExplorationPolicy,
    FrankaExpert,
    MultiPickupTask,
    PickupExpert,
    PickupTask,
)
from contactgraph.envs.contract import Policy, Task
from contactgraph.envs.gripper_task import MAX_FORCE

_FRANKA_FORCE = 20.0
"""N; stated here because the task itself can be imported with MuJoCo only."""


@dataclass(frozen=True)
class TaskOptions:
    """What a user may say about a task's scenes. None: the task's own choice."""

    distractors: int = 0
    objects: int | None = None
    grasp: str | None = None
    fixed_seed: int | None = None
    """Of the scene whose targets and goal all runs share."""
    radius: float | None = None
    """Of every body, m."""

    @property
    def metadata(self) -> dict[str, str | int | float]:
        """What was said, for the files that are made."""
        goal = None if self.fixed_seed is None else "fixed"
        told = {
            "objects": self.objects,
            "grasp": self.grasp,
            "goal": goal,
            "radius": self.radius,
        }
        given = {name: value for name, value in told.items() if value is not None}
        return {"distractors": self.distractors, **given}


TaskFactory = Callable[[], Task]


def _pickup(options: TaskOptions) -> TaskFactory:
    _refuse_grasp("pickup", options)
    _check_one_object("pickup", options)
    task = partial(PickupTask, options.distractors, fixed_seed=options.fixed_seed)
    return task if options.radius is None else partial(task, radius=options.radius)


def _multi_pickup(options: TaskOptions) -> TaskFactory:
    _refuse_grasp("multi-pickup", options)
    task = MultiPickupTask if options.objects is None else partial(MultiPickupTask, options.objects)
    return partial(task, distractors=options.distractors, fixed_seed=options.fixed_seed)


def _door(options: TaskOptions) -> TaskFactory:
    _refuse_grasp("door", options)
    if options.objects is not None:
        raise InvalidInputError(f"--objects: door has no objects to count, found {options.objects}")
    return partial(DoorTask, options.distractors, fixed_seed=options.fixed_seed)


def _franka(options: TaskOptions) -> TaskFactory:
    # Imported when it is asked for: MuJoCo may be missing, which this import says.
    from contactgraph_franka.envs.franka_task import FrankaTask
    from contactgraph_franka.envs.pickup import Grasp

    _check_one_object("franka", options)
    task = partial(FrankaTask, options.distractors, fixed_seed=options.fixed_seed)
    if options.grasp is None:
        return task
    grasp = choice("--grasp", options.grasp, {each.value: each for each in Grasp})
    return partial(task, grasp=grasp)


def _franka_explorer() -> Policy:
    # For a hand of 4 kg and steps of 0.01 s: it spreads by 0.1 m on each axis, within its reach.
    return ExplorationPolicy(deviation=2.0, correlation_steps=25.0, stiffness=20.0, damping=8.0)


@dataclass(frozen=True)
class KnownTask:
    """What belongs to the name of a task."""

    factory: Callable[[TaskOptions], TaskFactory]
    expert: Callable[[], Policy]
    """To train on: noise on its force tells masses from drags."""
    demonstrator: Callable[[], Policy]
    """The same expert without noise."""
    explorer: Callable[[], Policy] = ExplorationPolicy
    horizon: int = 20
    """Steps that a plan looks ahead where nobody says otherwise."""
    max_force: float = MAX_FORCE
    """Bound of the control on each axis, N."""


TASKS = {
    "pickup": KnownTask(_pickup, PickupExpert, partial(PickupExpert, noise=0.0)),
    "multi-pickup": KnownTask(_multi_pickup, PickupExpert, partial(PickupExpert, noise=0.0)),
    "door": KnownTask(_door, DoorExpert, partial(DoorExpert, noise=0.0)),
    "franka": KnownTask(
        _franka,
        FrankaExpert,
        partial(FrankaExpert, noise=0.0),
        _franka_explorer,
        horizon=50,
        max_force=_FRANKA_FORCE,
    ),
}


def task_factory(name: str, options: TaskOptions) -> TaskFactory:
    """Makes a task's environment; other processes can be sent it.

    Raises `InvalidInputError` for names and options that no task has.
    """
    factory = choice("task", name, TASKS).factory(options)
    if options.radius is not None and name != "pickup":
        raise InvalidInputError(f"--radius: only pickup has bodies of another size, found {name}")
    factory()  # a wrong count is refused before anything is begun
    return factory


def mixed_factories(name: str, options: TaskOptions) -> list[TaskFactory]:
    """A task's environments with 0 to ``distractors`` distractors, and 1 to ``objects`` objects.

    Objects None leaves them at the task's own number. Raises as `task_factory`, and where runs of
    one goal were to differ in their objects.
    """
    task_factory(name, options)
    if options.fixed_seed is not None and options.objects not in (None, 1):
        raise InvalidInputError(
            "--goal fixed: all runs have the same objects, so --mixed takes --objects 1 or none, "
            f"found {options.objects}"
        )
    counts = [None] if options.objects is None else range(1, options.objects + 1)
    return [
        task_factory(name, replace(options, distractors=bystanders, objects=count))
        for count in counts
        for bystanders in range(options.distractors + 1)
    ]


def _check_one_object(name: str, options: TaskOptions) -> None:
    if options.objects not in (None, 1):
        raise InvalidInputError(f"--objects: {name} has 1 object, found {options.objects}")


def _refuse_grasp(name: str, options: TaskOptions) -> None:
    if options.grasp is not None:
        raise InvalidInputError(f"--grasp: {name} has no fingers to close, found {options.grasp!r}")
