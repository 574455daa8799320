"""CSV files: a header of names with rows of numbers, or an export of Motive (OptiTrack).

Motive's layout is that of its format versions 1.2 to 1.25
(https://docs.optitrack.com/motive/data-export/data-export-csv): a line of properties, then one line
each for types, names, IDs and parts of the columns, and axes beside ``Frame`` and ``Time``.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.interchange.export_layout import MAP_FILE, ExportLayout, new_folder
from contactgraph.interchange.recording import (
    Column,
    Episode,
    Recording,
    check_count,
    check_file,
    files_of,
)

_LARGEST_FILE = 2**31
_MOST_COLUMNS = 10_000
_HEADER_ROWS = 20
_UNITS = {"Meters": 1.0, "Centimeters": 0.01, "Millimeters": 0.001}
_TIMES = ("time", "t", "timestamp")
_EPISODE = "episode"


def read_csv(source: Path) -> Recording:
    """The table in a file, or the tables of all files ``*.csv`` in a folder.

    A file is an episode, or has a column ``episode`` whose number changes from one to the next. The
    times of its rows are those of a column ``time``, ``t`` or ``timestamp``, s, if there is one.
    """
    episodes: list[Episode] = []
    rates: set[float | None] = set()
    count = 0
    for path in files_of(source, (".csv",)):
        check_file(path, _LARGEST_FILE)
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                first = file.readline(2**20)
                file.seek(0)
                rows = csv.reader(file, delimiter=max(",;\t", key=first.count))
                if first.lstrip('"').startswith("Format Version"):
                    found, rate = _motive(path, rows)
                else:
                    found, rate = _plain(path, rows), None
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            reason = " ".join(str(error).split())[:200]
            raise InvalidInputError(
                f"{path}: must be CSV in UTF-8, or is damaged ({reason})"
            ) from (error)
        count += sum(c.values.size for each in found for c in each.columns.values())
        check_count(str(source), count)
        episodes += found
        rates.add(rate)
    rate = rates.pop() if len(rates) == 1 else None
    return Recording(str(source), tuple(episodes), dt=1.0 / rate if rate else None)


def _plain(path: Path, rows: Iterator[list[str]]) -> list[Episode]:
    """The episodes of a table with one line of names."""
    names = [each.strip() for each in next(rows, [])]
    while names and not names[-1]:
        names.pop()
    if not names or not all(names) or len(set(names)) != len(names):
        raise InvalidInputError(f"{path}: must begin with a line of different names, found {names}")
    if len(names) > _MOST_COLUMNS:
        raise InvalidInputError(f"{path}: must have at most {_MOST_COLUMNS} columns")
    numbers, texts = _numbers(path, rows, len(names))
    others = {names[index]: text for index, text in texts.items()}
    there = {name: index for index, name in enumerate(names) if name not in others}
    lower = {name.lower(): index for name, index in there.items()}
    time = next((lower[name] for name in _TIMES if name in lower), None)
    parts = [numbers]
    if _EPISODE in lower:
        index = numbers[:, lower[_EPISODE]]
        parts = np.split(numbers, np.flatnonzero(np.diff(index)) + 1)
    episodes: list[Episode] = []
    for part in parts:
        stamps = None if time is None else part[:, time]
        columns = {name: Column(part[:, [index]], stamps) for name, index in there.items()}
        named = path.name if len(parts) == 1 else f"{path.name}: {_EPISODE} {len(episodes)}"
        episodes.append(Episode(named, columns, others))
    return episodes


def _numbers(
    path: Path, rows: Iterator[list[str]], width: int
) -> tuple[np.ndarray, dict[int, str]]:
    """Numbers [S, W] of rows, NaN for empty fields, and the first text of columns that have one."""
    texts: dict[int, str] = {}
    found: list[np.ndarray] = []
    for number, row in enumerate(rows, start=1):
        if not any(row):
            continue
        while len(row) > width and not row[-1].strip():
            row.pop()
        if len(row) != width:
            raise InvalidInputError(
                f"{path}: row {number} must have {width} fields, found {len(row)}"
            )
        check_count(str(path), len(found) * width)
        found.append(_row(row, number, texts))
    if not found:
        raise InvalidInputError(f"{path}: must have rows of numbers, found none")
    return np.stack(found), texts


def _row(row: list[str], number: int, texts: dict[int, str]) -> np.ndarray:
    try:
        return np.array(list(map(float, row)))
    except ValueError:
        numbers = np.full(len(row), np.nan)
        for index, each in enumerate(row):
            try:
                numbers[index] = float(each) if each.strip() else np.nan
            except ValueError:
                texts.setdefault(index, f"{each[:30]!r} in row {number}")
        return numbers


def _motive(path: Path, rows: Iterator[list[str]]) -> tuple[list[Episode], float | None]:
    """The take of a Motive export, and its frames a second."""
    first = next(rows)
    properties = dict(zip(first[::2], first[1::2], strict=False))
    unit = properties.get("Length Units", "Meters")
    if unit not in _UNITS:
        raise InvalidInputError(
            f"{path}: Length Units must be {' or '.join(_UNITS)}, found {unit[:30]!r}"
        )
    try:
        rate = float(properties.get("Export Frame Rate", "nan"))
    except ValueError:
        rate = np.nan
    header: list[list[str]] = []
    for row in rows:
        if row and row[0] == "Frame":
            break
        header.append(row)
        if len(header) > _HEADER_ROWS:
            break
    else:
        row = []
    if not row or row[0] != "Frame" or len(row) > _MOST_COLUMNS:
        raise InvalidInputError(f"{path}: must have a line of axes that begins with Frame")
    labelled = {each[1]: each for each in header if len(each) > 1 and each[1]}
    kinds, names = labelled.get("Type"), labelled.get("Name")
    parts = next((each for each in reversed(header) if len(each) > 2 and not each[1]), None)
    if names is None or parts is None or min(map(len, (names, parts, kinds or row))) < len(row):
        raise InvalidInputError(f"{path}: must have lines of Name and of Rotation and Position")
    numbers, texts = _numbers(path, rows, len(row))
    places: dict[str, list[int]] = {}
    for index in range(2, len(row)):
        kind = f" ({kinds[index]})" if kinds and kinds[index].endswith("Marker") else ""
        places.setdefault(f"{names[index]}{kind}.{parts[index].lower()}", []).append(index)
    columns, others = {}, {}
    for name, indices in places.items():
        text = next((texts[index] for index in indices if index in texts), None)
        if text is not None:
            others[name] = text
            continue
        scale = _UNITS[unit] if name.endswith(".position") else 1.0
        columns[name] = Column(scale * numbers[:, indices], numbers[:, 1])
    return [Episode(path.name, columns, others)], rate if rate > 0.0 else None


def write_csv(layout: ExportLayout, folder: Path) -> None:
    """Writes a file for each trajectory to a new folder; the last row has no control."""
    names = ["time", *layout.names, *layout.control_names]
    with new_folder(folder) as temporary:
        for index, each in enumerate(layout.dataset):
            times = each.scene.dt * np.arange(each.steps + 1)[:, None]
            states = np.concatenate([times, layout.states(each)], axis=1)
            control = [*each.control.tolist(), [""] * layout.dataset.control_size]
            path = temporary / f"{_EPISODE}-{index:06d}.csv"
            with path.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(names)
                for state, action in zip(states.tolist(), control, strict=True):
                    writer.writerow([*("" if each != each else each for each in state), *action])
        text = layout.map_text(
            lambda start, stop: json.dumps(layout.names[start:stop]),
            lambda start, stop: json.dumps(layout.control_names[start:stop]),
        )
        (temporary / MAP_FILE).write_text(text, encoding="utf-8")
