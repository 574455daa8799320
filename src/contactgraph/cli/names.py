"""Strings are looked up in the tables of the commands, and nowhere else."""

from typing import TypeVar

from contactgraph.data import InvalidInputError

Value = TypeVar("Value")


def looked_up(what: str, name: str, table: dict[str, Value]) -> Value:
    """The table's entry; where there is none, an error that lists those there are."""
    if name not in table:
        raise InvalidInputError(f"{what} must be one of {', '.join(table)}; found {name!r}")
    return table[name]
