"""Entries of import maps: columns of a recording with their scale and offset."""

import re
import reprlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.files import JsonFields
from contactgraph.interchange.recording import Column, Episode

_T = TypeVar("_T")
_LARGEST = 1e300
_SI = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "mN": 1e-3, "deg": np.pi / 180, "degrees": np.pi / 180}
_SI |= dict.fromkeys(("px", "latitude", "longitude"), np.nan)
"""SI units per unit that a name tells; NaN where that depends."""
_AXIS = re.compile(r"(.*[^A-Za-z])([xyzXYZ])")
_UNIT = re.compile(rf"(?:^|[^A-Za-z])({'|'.join(_SI)})(?:/s)?[)\]]?(?:\[|$)")


@dataclass(frozen=True, eq=False)
class Entries:
    """Numbers of a recording: ``scale * columns + offset``, or constant ones."""

    where: str
    columns: tuple[str | float, ...]
    """Columns of the recording, and numbers that stand for constant ones."""
    scale: np.ndarray = field(default_factory=lambda: np.ones(1))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(1))

    @property
    def names(self) -> str:
        """Of the columns, for people."""
        return ", ".join(map(str, self.columns))

    @property
    def constant(self) -> bool:
        """Whether nothing is recorded."""
        return not any(isinstance(each, str) for each in self.columns)

    def read(self, episode: Episode, *widths: int, missing: float | None = None) -> Column:
        """Of one of these widths, if any are given; constant ones have one row. Rows of which all
        recorded numbers are ``missing`` are NaN.
        """
        try:
            read = [episode.column(c) if isinstance(c, str) else c for c in self.columns]
        except InvalidInputError as error:
            raise InvalidInputError(f"{self.where}: {error}") from error
        columns = [each for each in read if isinstance(each, Column)]
        first = columns[0] if columns else Column(np.zeros((1, 0)))
        if any(not same_times(each, first) for each in columns):
            raise InvalidInputError(f"{self.where}: columns must have the same times")
        rows = np.ones((len(first.values), 1))
        values = np.hstack([c.values if isinstance(c, Column) else c * rows for c in read])
        if missing is not None:
            recorded = np.hstack([each.values for each in columns])
            values[(recorded == missing).all(axis=1)] = np.nan
        axes = "".join(each.axes for each in columns)
        found = replace(first, values=values, axes=axes)
        width, labels = found.values.shape[1], [each for c in columns for each in c.labels]
        names: list[tuple[Any, Any]] = [(name, self.scale) for name in self.columns]
        if len(labels) == width and len(self.scale) in (1, width):
            names += zip(labels, np.broadcast_to(self.scale, width)[:, None], strict=True)
        for name, each in names:
            unit, scale = _UNIT.search(str(name)), np.abs(each)
            if unit and (np.all(scale == 1.0) or np.all(np.abs(scale / _SI[unit[1]] - 1.0) > 0.1)):
                raise InvalidInputError(
                    f"{self.where}: {name!r} is in {unit[1]}: scale must be {_SI[unit[1]]:.6g}"
                )
        self._check_stems(episode)
        if widths and width not in widths:
            wanted = " or ".join(map(str, widths))
            raise InvalidInputError(f"{self.where} must have {wanted} numbers, found {width}")
        for name, each in (("scale", self.scale), ("offset", self.offset)):
            if len(each) not in (1, width):
                raise InvalidInputError(
                    f"{self.where}: {name} must be 1 or {width} numbers, found {len(each)}"
                )
        return replace(found, values=found.values * self.scale + self.offset)

    def _check_stems(self, episode: Episode) -> None:
        """Refuses an axis of another body where there is the own one."""
        found = [_AXIS.fullmatch(each) for each in self.columns if isinstance(each, str)]
        axes = [each for each in found if each is not None]
        for one, other in pairwise(axes):
            own = one[1] + other[2]
            if one[1] != other[1] and own in episode.columns and own not in self.columns:
                raise InvalidInputError(
                    f"{self.where}: {one[0]!r} goes with {own!r}, found {other[0]!r}"
                )


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
    return entries_of(JsonFields(where, {"columns": value}))


def entries_of(table: JsonFields, *further: str) -> Entries:
    """The entries that a table with ``columns`` is; ``further`` are valid keys beside its own."""
    check_keys(table, "columns", "scale", "offset", *further)
    columns = _columns(table.where, table.content.get("columns"))
    given = {key: array_at(table, key) for key in ("scale", "offset") if key in table.content}
    return Entries(table.where, columns, **{key: np.atleast_1d(given[key]) for key in given})


def _columns(where: str, value: Any) -> tuple[str | float, ...]:
    found = [value] if isinstance(value, str) else value
    if not isinstance(found, list) or not all(
        each if isinstance(each, str) else type(each) in (int, float) and abs(each) < _LARGEST
        for each in found or [""]
    ):
        raise InvalidInputError(
            f"{where}: columns must be a text such as 'name[0:2]', a number or a list of them, "
            f"found {reprlib.repr(value)}"
        )
    return tuple(each if isinstance(each, str) else float(each) for each in found)


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
