"""Entries of import maps: columns of a recording with their scale and offset."""

import reprlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.json_fields import JsonFields
from contactgraph.interchange.recording import Column, Episode

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Entries:
    """Numbers of a recording: ``scale * columns + offset``, or constant ones."""

    where: str
    columns: tuple[str, ...] = ()
    scale: np.ndarray = field(default_factory=lambda: np.ones(1))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(1))
    constant: np.ndarray | None = None

    def read(self, episode: Episode, *widths: int, missing: float | None = None) -> Column:
        """Of one of these widths, if any are given; constant ones have one row. Rows of which all
        recorded numbers are ``missing`` are NaN.
        """
        if self.constant is not None:
            found = Column(self.constant[None])
        else:
            try:
                parts = [episode.column(each) for each in self.columns]
            except InvalidInputError as error:
                raise InvalidInputError(f"{self.where}: {error}") from error
            first = parts[0]
            if any(not same_times(each, first) for each in parts[1:]):
                raise InvalidInputError(f"{self.where}: columns must have the same times")
            values = np.concatenate([each.values for each in parts], axis=1)
            values = np.where((values == missing).all(axis=1, keepdims=True), np.nan, values)
            axes = "".join(each.axes for each in parts)
            found = replace(first, values=values, axes=axes)
        width = found.values.shape[1]
        if widths and width not in widths:
            wanted = " or ".join(map(str, widths))
            raise InvalidInputError(f"{self.where} must have {wanted} numbers, found {width}")
        for name, each in (("scale", self.scale), ("offset", self.offset)):
            if len(each) not in (1, width):
                raise InvalidInputError(
                    f"{self.where}: {name} must be 1 or {width} numbers, found {len(each)}"
                )
        return replace(found, values=found.values * self.scale + self.offset)


def same_times(one: Column, other: Column) -> bool:
    """Whether the rows of two columns belong together."""
    if one.stamps is None or other.stamps is None:
        return one.stamps is other.stamps and len(one.values) == len(other.values)
    return one.stamps is other.stamps or np.array_equal(one.stamps, other.stamps)


def entries_at(table: JsonFields, name: str, further: tuple[str, ...] = ()) -> Entries | None:
    """The entries under a key: columns, a table with ``columns``, or numbers; None without it.

    ``further`` are valid keys of the table beside its own.
    """
    value, where = table.content.get(name), f"{table.where}: {name}"
    if value is None:
        return None
    if isinstance(value, dict):
        return entries_of(table.inner(name), *further)
    if isinstance(value, list) and value and not isinstance(value[0], str):
        return Entries(where, constant=table.numbers(name, (None,)))
    return Entries(where, _columns(where, value))


def entries_of(table: JsonFields, *further: str) -> Entries:
    """The entries that a table with ``columns`` is; ``further`` are valid keys beside its own."""
    check_keys(table, "columns", "scale", "offset", *further)
    columns = _columns(table.where, table.content.get("columns"))
    given = {key: array_at(table, key) for key in ("scale", "offset") if key in table.content}
    return Entries(table.where, columns, **{key: np.atleast_1d(given[key]) for key in given})


def _columns(where: str, value: Any) -> tuple[str, ...]:
    found = [value] if isinstance(value, str) else value
    texts = isinstance(found, list) and all(isinstance(each, str) and each for each in found)
    if not texts or not found:
        raise InvalidInputError(
            f"{where}: columns must be a text such as 'name[0:2]' or a list of them, "
            f"found {reprlib.repr(value)}"
        )
    return tuple(found)


def array_at(table: JsonFields, name: str) -> np.ndarray:
    """Finite numbers of any shape, or whole ones."""
    value, axes = table.content.get(name), 0
    while isinstance(value, list) and value:
        value, axes = value[0], axes + 1
    return table.numbers(name, (None,) * axes)


def optional(table: JsonFields, name: str, read: Callable[[JsonFields, str], _T]) -> _T | None:
    """What is read under a key; None without it."""
    return read(table, name) if name in table.content else None


def positive_at(table: JsonFields, name: str) -> float:
    """A number above 0."""
    value = table.number(name)
    if value <= 0.0:
        raise InvalidInputError(f"{table.where}: {name} must be above 0, found {value}")
    return value


def check_keys(table: JsonFields, *known: str) -> None:
    """Refuses a key that is not known."""
    for key in table.content:
        if key not in known:
            raise InvalidInputError(
                f"{table.where}: no key {key!r}; valid keys are {', '.join(known)}"
            )
