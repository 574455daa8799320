"""Tasks by name: those of the library, of other packages (entry points), or ``module:Class``.

A package adds a `KnownTask` by an entry point of the group ``contactgraph.tasks``, which is
imported only when the task is asked for. JAX is not needed to record trajectories.
"""

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from typing import Any, cast

from contactgraph.cli.known_tasks import TASKS
from contactgraph.cli.options import choice, load_entry_point, load_object
from contactgraph.cli.task_types import KnownTask, TaskFactory, TaskOptions, refuse_option
from contactgraph.data import InvalidInputError
from contactgraph.envs import ExplorationPolicy
from contactgraph.envs.contract import Task
from contactgraph.envs.planar.world import engine_name

_GROUP = "contactgraph.tasks"


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
        "passive": options.passive or None,
        "hidden_switch": options.hidden_switch or None,
        "lose_grasp": options.lose_grasp or None,
        "in_the_way": options.in_the_way or None,
        "engine": options.engine,
    }
    given = {key: value for key, value in given.items() if value is not None}
    for key, value in given.items():
        if key not in parameters:
            flag = f"--{key.replace('_', '-')}"
            flag, found = (flag, value) if key != "fixed_seed" else ("--goal", "fixed")
            refuse_option(name, flag, found, f"takes no argument {key!r}")
    return partial(task_class, **given)


def task_factory(name: str, options: TaskOptions) -> TaskFactory:
    """Makes a task's environment; the factory can be sent to other processes.

    Raises `InvalidInputError` for an unknown name, and for options that the task does not take.
    """
    if options.radius is not None and name != "pickup" and ":" not in name:
        known_task(name)
        raise InvalidInputError(f"--radius: only pickup has bodies of another size, found {name}")
    if options.passive and ":" not in name and not known_task(name).passive:
        names = ", ".join(each for each, task in TASKS.items() if task.passive)
        raise InvalidInputError(f"--passive: only {names} move without a control, found {name}")
    if options.hidden_switch and name != "suction" and ":" not in name:
        known_task(name)
        raise InvalidInputError(f"--hidden-switch: only suction has a switch, found {name}")
    if options.lose_grasp and name != "suction" and ":" not in name:
        known_task(name)
        raise InvalidInputError(f"--lose-grasp: only suction loses its grasp, found {name}")
    if options.in_the_way and name != "pickup" and ":" not in name:
        known_task(name)
        raise InvalidInputError(f"--in-the-way: only pickup has such scenes, found {name}")
    factory = known_task(name).factory(options)
    if ":" not in name:
        if "engine" in inspect.signature(factory).parameters:
            factory = partial(cast(Any, factory), engine=engine_name(options.engine))
        elif options.engine is not None:
            raise InvalidInputError(f"--engine: only planar tasks have a choice, found {name}")
    factory()  # an invalid count is refused before any work is done
    return factory


def make(
    task: str,
    *,
    distractors: int = 0,
    objects: int | None = None,
    grasp: str | None = None,
    fixed_seed: int | None = None,
    radius: float | None = None,
    passive: bool = False,
    hidden_switch: bool = False,
    lose_grasp: float = 0.0,
    in_the_way: bool = False,
    engine: str | None = None,
) -> Task:
    """A task by its name, or by that of its class, ``module:Class``; see `TaskOptions`.

    Raises `InvalidInputError` as `task_factory`. `contactgraph.make` is this.

    >>> import contactgraph
    >>> task = contactgraph.make("pickup", distractors=2)
    >>> observation, _ = task.reset(seed=0)
    >>> task.scene
    Scene(1 gripper, 3 object; N=4, D=2, dt=0.05 s)
    """
    scene = distractors, objects, grasp, fixed_seed, radius
    other = passive, hidden_switch, lose_grasp, in_the_way, engine
    return task_factory(task, TaskOptions(*scene, *other))()


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
