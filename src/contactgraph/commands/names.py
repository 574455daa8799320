"""The names a user types, and what they stand for. Strings are looked up here and nowhere else."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from contactgraph.data import InvalidInputError
from contactgraph.model import (
    Preset,
    full_ab,
    gim_non_temp,
    gim_temp,
    no_gim,
    paper_literal,
    paper_literal_no_gim,
    shipped_model,
    shipped_models,
)
from contactgraph.tasks import DoorExpert, DoorTask, MultiPickupTask, PickupExpert, PickupTask
from contactgraph.tasks.contract import Policy, Task

Value = TypeVar("Value")

MODELS: dict[str, Preset] = {
    "gim-temp": gim_temp,
    "gim-non-temp": gim_non_temp,
    "no-gim": no_gim,
    "full-ab": full_ab,
    "paper-literal": paper_literal,
    "paper-literal-no-gim": paper_literal_no_gim,
}
EXPERTS: dict[str, Callable[[], Policy]] = {
    "pickup": PickupExpert,
    "multi-pickup": PickupExpert,
    "door": DoorExpert,
}


def looked_up(what: str, name: str, table: dict[str, Value]) -> Value:
    """The table's entry; where there is none, an error that lists those there are."""
    if name not in table:
        raise InvalidInputError(f"{what} must be one of {', '.join(table)}; found {name!r}")
    return table[name]


def task_factory(name: str, distractors: int, objects: int | None) -> Callable[[], Task]:
    """Makes a task's environment. Raises `InvalidInputError` for names and counts that no task has.

    `objects` None is the task's own number.
    """

    def pickup() -> Task:
        if objects not in (None, 1):
            raise InvalidInputError(f"--objects: pickup has 1 object, found {objects}")
        return PickupTask(distractors=distractors)

    def multi_pickup() -> Task:
        if objects is None:
            return MultiPickupTask(distractors=distractors)
        return MultiPickupTask(objects, distractors)

    def door() -> Task:
        if objects is not None:
            raise InvalidInputError(f"--objects: door has no objects to count, found {objects}")
        return DoorTask(distractors)

    tasks = {"pickup": pickup, "multi-pickup": multi_pickup, "door": door}
    factory = looked_up("task", name, tasks)
    factory()  # a wrong count is refused before anything is begun
    return factory


def mixed_factories(name: str, distractors: int, objects: int | None) -> list[Callable[[], Task]]:
    """A task's environments with 0 to ``distractors`` distractors, and 1 to ``objects`` objects.

    `objects` None leaves the objects at the task's own number. Raises as `task_factory`.
    """
    task_factory(name, distractors, objects)
    counts = [None] if objects is None else range(1, objects + 1)
    return [
        task_factory(name, bystanders, count)
        for count in counts
        for bystanders in range(distractors + 1)
    ]


def model_path(run: str) -> Path:
    """The model file of a run folder, a model file itself, or a model that ships with the package.

    Raises `InvalidInputError` where there is none.
    """
    path = Path(run)
    if path.is_file():
        return path
    if path.is_dir():
        inside = path / "model.safetensors"
        if inside.is_file():
            return inside
        raise InvalidInputError(
            f"{run}: has no model.safetensors; it must be a folder that train has made"
        )
    if run in shipped_models():
        return shipped_model(run)
    raise InvalidInputError(
        f"{run}: no such run folder or model file; models that ship are "
        f"{', '.join(shipped_models())}"
    )
