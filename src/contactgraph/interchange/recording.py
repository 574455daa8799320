"""Recordings of other formats: episodes of named columns of numbers, as every reader has them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.files import JsonFields, check_readable, parse_json

LARGEST = 2**27
"""Limit of the numbers of a recording, 1 GiB: more than anyone can train on."""
_LARGEST_JSON = 2**24
"""Bytes."""
_SLICE = re.compile(r"(?P<name>.+)\[(?P<start>\d{1,9})(?::(?P<stop>\d{1,9}))?\]")
_POINTER = b"version https://git-lfs"
_NUMBER = re.compile(r"(\d+)")
_SHOWN = 30
"""Columns that an error lists."""


@dataclass(frozen=True, eq=False)
class Column:
    """Numbers over time. Those of actions may have one row less than those of states."""

    values: np.ndarray
    """[S, W]; NaN where nothing was measured."""
    stamps: np.ndarray | None = None
    """[S] s. None: those of the episode, or its steps."""
    frame: str = ""
    """Of the coordinates, where the format tells it."""
    axes: str = ""
    """What the numbers are, where the format or a name tells it: the letters of ``wxyz``, or of
    Euler angles in SciPy's notation."""
    labels: tuple[str, ...] = ()
    """Of each number, where the format tells them."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One recording without interruption."""

    name: str
    columns: dict[str, Column]
    others: dict[str, str] = field(default_factory=dict)
    """Columns that cannot be read as numbers, and what they hold."""
    no_times: str = ""
    """Why rows have no times, where they should."""
    used: set[str] = field(default_factory=set)
    """Columns that were asked for."""
    steps: np.ndarray | None = None
    """[S] numbers of the rows' steps, where they have no times and not every step has a row."""

    def column(self, reference: str) -> Column:
        """The columns that ``name``, ``name[i]`` or ``name[start:stop]`` refers to.

        Raises `InvalidInputError`, which lists what is there, for others.
        """
        sliced = None if reference in self.columns else _SLICE.fullmatch(reference)
        name = sliced["name"] if sliced else reference
        each = range(int(sliced["start"]), int(sliced["stop"] or 0)) if sliced else range(0)
        if each and f"{name}[{each.start}]" in self.columns:  # in the names of single ones
            parts = [self.column(f"{name}[{index}]") for index in each]
            return replace(parts[0], values=np.hstack([part.values for part in parts]))
        for other in self.others if reference not in self.columns else ():
            if name == other or name.startswith(f"{other}."):
                found = self.others[other]
                raise InvalidInputError(f"column {name!r} must be numbers, found {found}")
        if name not in self.columns:
            there = [f"{each}[{c.values.shape[1]}]" for each, c in self.columns.items()]
            more = f", … ({len(there)} in all)" if len(there) > _SHOWN else ""
            raise InvalidInputError(
                f"no column {reference!r}; there are {', '.join(there[:_SHOWN])}{more}"
            )
        self.used.add(name)
        column = self.columns[name]
        if sliced is None:
            return column
        start, width = int(sliced["start"]), column.values.shape[1]
        stop = int(sliced["stop"]) if sliced["stop"] else start + 1
        if not start < stop <= width:
            raise InvalidInputError(f"{reference!r} must lie in {name}[0:{width}]")
        part = slice(start, stop)
        return replace(
            column,
            values=column.values[:, part],
            axes=column.axes[part],
            labels=column.labels[part],
        )


@dataclass(frozen=True, eq=False)
class Recording:
    """The content of a file or folder of another format."""

    where: str
    episodes: tuple[Episode, ...]
    dt: float | None = None
    """Time between two rows, s, where the format tells it."""
    environment: str = ""
    """The environment that was recorded, where the format tells it."""

    def __post_init__(self) -> None:
        if not self.episodes:
            raise InvalidInputError(f"{self.where}: must hold at least one episode, found none")
        for each in self.episodes:
            if not each.columns:
                there = [f"{name} ({what})" for name, what in each.others.items()][:_SHOWN]
                raise InvalidInputError(
                    f"{self.where}: {each.name}: must have columns of numbers, found "
                    f"{', '.join(there) or 'none'}"
                )


def check_count(where: str, count: int) -> None:
    """Refuses more numbers than a recording may have."""
    if not 0 <= count <= LARGEST:
        raise InvalidInputError(f"{where}: must hold at most {LARGEST} numbers, found {count}")


def check_file(path: Path, largest: int) -> None:
    """Refuses what is no file, or has more bytes."""
    check_readable(path)
    if path.stat().st_size > largest:
        raise InvalidInputError(f"{path}: must have at most {largest} bytes")
    with path.open("rb") as file:
        head = file.read(len(_POINTER))
    if not head or head == _POINTER:
        what = "is a pointer of Git LFS; `git lfs pull` fetches the file" if head else "is empty"
        raise InvalidInputError(f"{path}: {what}")


def read_json(path: Path) -> JsonFields:
    """The JSON object in a file; raises `InvalidInputError` where it holds something else."""
    check_file(path, _LARGEST_JSON)
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"{path}: must be JSON, or is damaged ({reason})") from error
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path}: must be a JSON object")
    return JsonFields(str(path), content)


def files_of(source: Path, suffixes: Sequence[str]) -> list[Path]:
    """The file ``source``, or the files of these suffixes in that folder, by name and number."""
    if not source.is_dir():
        return [source]
    found = [each for each in source.iterdir() if each.suffix.lower() in suffixes]
    found.sort(key=lambda each: [int(p) if p.isdecimal() else p for p in _NUMBER.split(each.name)])
    if not found:
        others = ", ".join(sorted({each.suffix for each in source.iterdir() if each.suffix}))
        raise InvalidInputError(
            f"{source}: no file that ends in {' or '.join(suffixes)}, found {others or 'none'}"
        )
    return found
