"""contactgraph: learn which objects touch when, and control through contact.

The names below are imported on first use, so that ``import contactgraph`` takes no time.
``import contactgraph.gym`` registers the tasks with Gymnasium.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contactgraph import plot as plot
    from contactgraph.cli.models import stored_model as load
    from contactgraph.control import ILQR as ILQR
    from contactgraph.control import MPC as MPC
    from contactgraph.control import QuadraticCost as QuadraticCost
    from contactgraph.data import read_trajectories as read
    from contactgraph.data import write_trajectories as write
    from contactgraph.envs.registry import make as make
    from contactgraph.train import fit as fit

__all__ = ["ILQR", "MPC", "QuadraticCost", "fit", "load", "make", "plot", "read", "write"]
__version__ = "0.1.0"

_NAMES = {
    "ILQR": ("contactgraph.control", "ILQR"),
    "MPC": ("contactgraph.control", "MPC"),
    "QuadraticCost": ("contactgraph.control", "QuadraticCost"),
    "fit": ("contactgraph.train", "fit"),
    "load": ("contactgraph.cli.models", "stored_model"),
    "make": ("contactgraph.envs.registry", "make"),
    "plot": ("contactgraph.plot", None),
    "read": ("contactgraph.data", "read_trajectories"),
    "write": ("contactgraph.data", "write_trajectories"),
}


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
