"""Tasks by name: those of the library, of other packages (entry points), or ``module:Class``.

A package adds a `KnownTask` by an entry point of the group ``contactgraph.tasks``, which is
imported only when the task is asked for. JAX is not needed to record trajectories.
"""

import inspect
from collections.abc import Mapping
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from contactgraph.cli.known_tasks import TASKS
from contactgraph.cli.options import choice, load_entry_point, load_object
from contactgraph.cli.task_types import FLAGS, KnownTask, TaskFactory
from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.envs.contract import Task
from contactgraph.envs.planar.world import ENGINES, engine_name

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
    """See `KnownTask.of_class`."""
    loaded = load_object("task", name)
    if not inspect.isclass(loaded):
        raise InvalidInputError(f"task {name}: must be a class, found {loaded!r}")
    return KnownTask.of_class(loaded)


def task_factory(name: str, options: Mapping[str, Any]) -> TaskFactory:
    """Makes a task with these arguments; the factory can be sent to other processes.

    Raises `InvalidInputError` for an unknown name, and for options that the task does not take.
    """
    known, given = known_task(name), dict(options)
    parameters = inspect.signature(known.make).parameters
    if known.passive and "passive" not in parameters:
        given.pop("passive", None)  # it always is
    unknown = next((each for each in given if each not in parameters), None)
    if unknown is not None:
        flags = [_flag(each) for each in (*FLAGS, "fixed_seed") if each in parameters]
        raise InvalidInputError(
            f"{_flag(unknown)}: {name} has no such option; it has {', '.join(flags) or 'none'}"
        )
    if "engine" in parameters and ":" not in name:
        given["engine"] = engine_name(given.get("engine"))
    factory = partial(known.make, **given)
    factory()  # an invalid count is refused before any work is done
    return factory


def _flag(option: str) -> str:
    return "--goal fixed" if option == "fixed_seed" else f"--{option.replace('_', '-')}"


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


def recorded_task(dataset: Dataset, trajectory: Trajectory) -> Task:
    """The task of an episode in a dataset, with the options and the engine of its metadata.

    Raises `InvalidInputError` where these name no planar task, or no seed. A file does not get to
    import a class: it names tasks only.
    """
    metadata = {**dataset.metadata, **trajectory.scene.metadata}
    name, engine = str(metadata.get("task")), str(metadata.get("simulator")).partition(" ")[0]
    seeded = isinstance(trajectory.scene.metadata.get("seed"), int)
    if engine not in ENGINES or name not in task_names() or not seeded:
        raise InvalidInputError(
            "forced windows need episodes of planar tasks, recorded by collect, with their seeds; "
            f"found task {name}, simulator {metadata.get('simulator')}"
        )
    parameters = inspect.signature(known_task(name).make).parameters
    options = {each: value for each, value in metadata.items() if each in parameters}
    try:
        return make(name, **{**options, "engine": engine})
    except TypeError as error:
        raise InvalidInputError(f"the metadata do not describe a task {name}: {error}") from error


def mixed_factories(name: str, options: Mapping[str, Any]) -> list[TaskFactory]:
    """A task's environments with 0 to ``distractors`` distractors, and 1 to ``objects`` objects.

    Raises as `task_factory`, and if episodes of one goal were to differ in their objects.
    """
    task_factory(name, options)
    most, others = options.get("objects"), dict(options)
    if options.get("fixed_seed") is not None and most not in (None, 1):
        raise InvalidInputError(
            "--goal fixed: all episodes have the same objects, so --mixed takes --objects 1 or "
            f"none, found {most}"
        )
    counts = [{}] if most is None else [{"objects": each} for each in range(1, most + 1)]
    distractors = others.pop("distractors", None)
    more = [{}] if distractors is None else [{"distractors": n} for n in range(distractors + 1)]
    return [task_factory(name, {**others, **one, **other}) for one in counts for other in more]
