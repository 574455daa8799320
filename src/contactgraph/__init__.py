"""contactgraph: learn which objects touch when, and control through contact.

The names below are imported on first use, so that ``import contactgraph`` takes no time. Gymnasium
knows the tasks as soon as it and this package are imported, in either order.
"""

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contactgraph import plot as plot
    from contactgraph.cli.models import stored_model as load
    from contactgraph.cli.tasks import make as make
    from contactgraph.control import ILQR as ILQR
    from contactgraph.control import MPC as MPC
    from contactgraph.control import QuadraticCost as QuadraticCost
    from contactgraph.data import read_trajectories as read
    from contactgraph.data import write_trajectories as write
    from contactgraph.train import fit as fit

__all__ = ["ILQR", "MPC", "QuadraticCost", "fit", "load", "make", "plot", "read", "write"]
__version__ = "0.1.0"

_NAMES = {
    "ILQR": ("contactgraph.control", "ILQR"),
    "MPC": ("contactgraph.control", "MPC"),
    "QuadraticCost": ("contactgraph.control", "QuadraticCost"),
    "fit": ("contactgraph.train", "fit"),
    "load": ("contactgraph.cli.models", "stored_model"),
    "make": ("contactgraph.cli.tasks", "make"),
    "plot": ("contactgraph.plot", None),
    "read": ("contactgraph.data", "read_trajectories"),
    "write": ("contactgraph.data", "write_trajectories"),
}
_TASKS = (
    *("pickup", "multi-pickup", "door", "billiards", "toss", "dominoes", "stack", "chain"),
    *("unknown-mass", "springs", "suction", "release", "delay", "sticky", "pusht", "pusht-pose"),
    *("fetch-push", "fetch-slide", "fetch-pick-and-place", "franka"),
)
"""Names of tasks, known without importing them."""


def __getattr__(name: str) -> object:
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _NAMES[name]
    found: object = import_module(module)
    if attribute is not None:
        found = getattr(found, attribute)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _register() -> None:
    """Give Gymnasium the names of the tasks: ``pusht-pose`` is ``contactgraph/PushtPose-v0``."""
    from gymnasium.envs.registration import register

    for task in _TASKS:
        name = "".join(part.capitalize() for part in task.split("-"))
        register(
            id=f"contactgraph/{name}-v0",
            entry_point="contactgraph.cli.gymnasium_task:GymnasiumTask",
            kwargs={"task": task},
        )


class _RegisterOnImport:
    """Calls `_register` once Gymnasium is imported, which takes longer than this package may."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if name != "gymnasium.envs":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                run(module)
                _register()

            spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec


if "gymnasium.envs" in sys.modules:
    _register()
else:
    sys.meta_path.insert(0, _RegisterOnImport())
