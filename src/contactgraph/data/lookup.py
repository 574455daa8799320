"""Objects by name: of a table, of a module, or of an installed package."""

import importlib
import sys
from importlib.metadata import entry_points
from typing import Any, TypeVar

from contactgraph.data.errors import InvalidInputError

Value = TypeVar("Value")


def choice(what: str, name: str, table: dict[str, Value]) -> Value:
    """The table's entry. Raises `InvalidInputError`, which lists the valid names, without one."""
    if name not in table:
        raise InvalidInputError(f"{what} must be one of {', '.join(table)}; found {name!r}")
    return table[name]


def load_object(what: str, name: str) -> Any:
    """The object ``module:name``; modules are also looked for in the current folder.

    Raises `InvalidInputError` if the module cannot be imported or has no such name.
    """
    module_name, _, attribute = name.partition(":")
    if "" not in sys.path:
        sys.path.append("")  # worker processes get the same path
    try:
        found: Any = importlib.import_module(module_name)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidInputError(f"{what} {name}: {error}") from error
    return found


def load_entry_point(group: str, name: str) -> type | None:
    """The class that an installed package registers as ``name`` in ``group``; None without one.

    Raises `InvalidInputError`, which names the entry point, if it cannot be loaded.
    """
    for entry in entry_points(group=group, name=name):
        try:
            loaded = entry.load()
            if not isinstance(loaded, type):
                raise TypeError(f"it must be a class, found {loaded!r}")
            return loaded
        except InvalidInputError:  # a missing extra
            raise
        except Exception as error:
            reason = f"{name}: entry point {entry.value} cannot be loaded: {error}"
            package = "its package" if entry.dist is None else entry.dist.name
            raise InvalidInputError(f"{reason}; reinstall {package}") from error
    return None
