"""CSV files: a header of names with rows of numbers, or an export of Motive or of Vicon Nexus.

Motive's layout is that of its format versions 1.2 to 1.25
(https://docs.optitrack.com/motive/data-export/data-export-csv): a line of properties, then one line
each for types, names, IDs and parts of the columns, and axes beside ``Frame`` and ``Time``. Nexus
writes sections, each with a line for its kind, rate, names, axes and units.
"""

import csv
import json
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import chain, takewhile
from pathlib import Path
from typing import TextIO

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
_TIME = re.compile(
    r"t|(?i:time(?:stamp)?|elapsed|seconds)(?:[ _]*[(\[]?(?P<unit>s|sec|seconds|ms|us|ns)[)\]]?)?"
)
_UNIT = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_FRAMES = ("frame", "frame_index", "frame_number")
_EPISODE = "episode"
_AXIS = re.compile(r"(?i:.*[._ ]q?|q)(?P<axis>[wxyzWXYZ])")
_NEXUS = ("Trajectories", "Segments", "Joints", "Devices", "Model Outputs")
_NEXUS_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "deg": np.pi / 180.0, "rad": 1.0}


def read_csv(source: Path) -> Recording:
    """The table in a file, or the tables of all files ``*.csv`` in a folder.

    A file is an episode, or has a column ``episode``, whose rows of one value are one. The times of
    its rows are those of a column ``time``, ``t``, ``timestamp`` or ``elapsed``, in s, in the unit
    in its name (``time_ms``) or as ISO 8601 texts, if there is one; else a column ``frame`` numbers
    their steps. Lines that begin with ``#`` above the names are comments; the last one has the
    names where no other line has.
    """
    episodes: list[Episode] = []
    rates: set[float | None] = set()
    count = 0
    for path in files_of(source, (".csv",)):
        check_file(path, _LARGEST_FILE)
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                first, delimiter, comment = _first_line(file)
                rows = csv.reader(file, delimiter=delimiter)
                if first.lstrip('"').startswith("Format Version"):
                    found, rate = _motive(path, rows, delimiter != ",")
                elif first.strip(f'"\r\n{delimiter}') in _NEXUS:
                    found, rate = _nexus(path, rows, delimiter != ",")
                else:
                    names, below = _names(path, rows, comment.split(delimiter))
                    found, rate = _plain(path, names, below, delimiter != ","), None
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            reason = " ".join(str(error).split())[:200]
            message = f"{path}: must be CSV in UTF-8, or is damaged ({reason})"
            raise InvalidInputError(message) from error
        count += sum(c.values.size for each in found for c in each.columns.values())
        check_count(str(source), count)
        episodes += found
        rates.add(rate)
    rate = rates.pop() if len(rates) == 1 else None
    return Recording(str(source), tuple(episodes), dt=1.0 / rate if rate else None)


def _first_line(file: TextIO) -> tuple[str, str, str]:
    """The first line of the table, from which the file goes on, the delimiter, and the comment
    above."""
    delimiter = comment = ""
    while True:
        at, first = file.tell(), file.readline(2**20)
        if first.lower().startswith("sep="):
            delimiter = first[4:5]
        elif first.startswith("#"):
            comment = first[1:]
        else:
            file.seek(at)
            return first, delimiter.strip("\r\n") or max(",;\t", key=first.count), comment


def _names(
    path: Path, rows: Iterator[list[str]], comment: list[str]
) -> tuple[list[str], Iterator[list[str]]]:
    """The names of a table, of the first row, or of the comment above where that row has numbers;
    and the rows below."""
    row = next(rows, [])
    numbers = " ".join(row).split()
    names = [each.strip() for each in row]
    if numbers and all(map(_is_number, numbers)):
        names, rows = [each.strip() for each in comment], chain([row], rows)
        if not len(names) == len(row) == len(numbers):
            raise InvalidInputError(
                f"{path}: must begin with a line of names, separated by commas, semicolons or "
                f"tabs, found numbers: {numbers[0][:30]!r}"
            )
    while names and not names[-1]:
        names.pop()
    if names and not names[0]:
        names[0] = "index"  # of a data frame
    if not names or not all(names) or len(set(names)) != len(names):
        raise InvalidInputError(f"{path}: must begin with a line of different names, found {names}")
    if len(names) > _MOST_COLUMNS:
        raise InvalidInputError(f"{path}: must have at most {_MOST_COLUMNS} columns")
    return names, rows


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _plain(path: Path, names: list[str], rows: Iterator[list[str]], comma: bool) -> list[Episode]:
    """The episodes of a table with these names; ``comma``: as decimal point, too."""
    lower = {name.lower(): index for index, name in enumerate(names)}
    clocks = {index: match for index, name in enumerate(names) if (match := _TIME.fullmatch(name))}
    time = min(clocks, key=lambda index: (names[index].lower() != "time", index), default=None)
    raw: dict[int, list[str]] = {
        index: [] for index in (time, lower.get(_EPISODE)) if index is not None
    }
    numbers, texts = _numbers(path, rows, len(names), comma, raw)
    no_times, scale = "", 1.0 if time is None else _UNIT.get(clocks[time]["unit"] or "s", 1.0)
    if time in texts and time is not None:
        try:
            numbers[:, time] = _seconds(raw[time]) / scale
        except (ValueError, TypeError):
            no_times = f"column {names[time]!r} must be s or ISO 8601 times, found {texts[time]}"
            time = None
    others = {names[index]: text for index, text in texts.items() if index != time}
    there = {name: index for index, name in enumerate(names) if name not in others}
    parts = [np.arange(len(numbers))]
    if _EPISODE in lower:
        _, firsts, which = np.unique(raw[lower[_EPISODE]], return_index=True, return_inverse=True)
        parts = [np.flatnonzero(which == index) for index in np.argsort(firsts)]
    episodes: list[Episode] = []
    for part in parts:
        stamps = None if time is None else scale * numbers[part, time]
        columns = {
            name: Column(numbers[part][:, [index]], stamps, axes=_axis(name))
            for name, index in there.items()
        }
        frames = next((columns[name].values for name in _FRAMES if name in columns), None)
        label = raw[lower[_EPISODE]][part[0]] if len(parts) > 1 else ""
        named = f"{path.name}: {_EPISODE} {label}" if label else path.name
        used = {names[index] for index in (time, lower.get(_EPISODE)) if index is not None}
        steps = None if time is not None or frames is None else _steps(frames[:, 0])
        episodes.append(Episode(named, columns, others, no_times, used, steps))
    return episodes


def _axis(name: str) -> str:
    """The last letter of ``q_w`` or ``qw``, which tells the place of a number in a quaternion."""
    found = _AXIS.fullmatch(name)
    return found["axis"].lower() if found else ""


def _steps(frames: np.ndarray) -> np.ndarray | None:
    """[S] of rows that are numbered by frames, of which some are missing."""
    apart = np.diff(frames)
    numbered = len(apart) and np.all(apart >= 1.0) and np.median(apart) == 1.0
    return frames - frames[0] if numbered and np.all(apart == np.round(apart)) else None


def _seconds(texts: Sequence[str]) -> np.ndarray:
    """[S] s since the first of ISO 8601 times; raises `ValueError` or `TypeError`."""
    times = [datetime.fromisoformat(text.strip()) for text in texts]
    return np.array([(each - times[0]).total_seconds() for each in times])


def _numbers(
    path: Path,
    rows: Iterator[list[str]],
    width: int,
    comma: bool = False,
    raw: dict[int, list[str]] | None = None,
) -> tuple[np.ndarray, dict[int, str]]:
    """Numbers [S, W] of rows, NaN for empty fields; the first text of each column that has one.

    ``raw`` gets the texts of its columns.
    """
    texts: dict[int, str] = {}
    found: list[np.ndarray] = []
    marks: set[str] = set()
    blank = 0
    for number, row in enumerate(rows, start=1):
        if not row or (raw and not any(row)):
            continue
        while len(row) > width and not row[-1].strip():
            row.pop()
        if len(row) != width:
            raise InvalidInputError(
                f"{path}: row {number} must have {width} fields, found {len(row)}"
            )
        check_count(str(path), len(found) * width)
        found.append(_row(row, number, texts, comma))
        blank = 0 if any(row) else blank + 1
        if comma and len(marks) < 2:
            marks |= {mark for each in filter(_is_number, row) for mark in ".," if mark in each}
        for index, each in (raw or {}).items():
            each.append(row[index])
    found = found[: len(found) - blank]
    if not found:
        raise InvalidInputError(f"{path}: must have rows of numbers, found none")
    if len(marks) > 1:
        raise InvalidInputError(f"{path}: numbers must all have a decimal point, or all a comma")
    return np.stack(found), texts


def _row(row: list[str], number: int, texts: dict[int, str], comma: bool) -> np.ndarray:
    try:
        if "_" in "".join(row):  # Python reads 1_5 as 15
            raise ValueError
        return np.array(list(map(float, row)))
    except ValueError:
        numbers = np.full(len(row), np.nan)
        for index, each in enumerate(row):
            try:
                text = each.replace(",", ".") if comma else each
                numbers[index] = float(text.replace("_", "text")) if text.strip() else np.nan
            except ValueError:
                texts.setdefault(index, f"{each[:30]!r} in row {number}")
        return numbers


def _nexus(
    path: Path, rows: Iterator[list[str]], comma: bool
) -> tuple[list[Episode], float | None]:
    """The trial of an export of Vicon Nexus, and its frames a second."""
    columns: dict[str, Column] = {}
    others: dict[str, str] = {}
    rates: set[float] = set()
    for kind in rows:
        if not any(kind):
            continue
        head = [next(rows, []) for _ in range(4)]
        table = list(takewhile(any, rows))
        while head[2] and not head[2][-1]:
            head[2].pop()  # which Excel adds
        (rate_text, *_), names, axes, units = (each or [""] for each in head)
        if kind[0] not in _NEXUS[:2]:
            others[kind[0]] = "of Nexus, beside trajectories and segments"
            continue
        width = len(axes)
        try:
            rate = float(rate_text)
        except ValueError:
            rate = np.nan
        if not rate > 0.0 or axes[:2] != ["Frame", "Sub Frame"] or width > _MOST_COLUMNS:
            raise InvalidInputError(
                f"{path}: {kind[0]} must have lines of a rate, names, axes after Frame and Sub "
                "Frame, and units"
            )
        numbers, texts = _numbers(path, iter(table), width, comma)
        rates.add(rate)
        places: dict[str, list[int]] = {}
        name = ""
        for index in range(2, width):
            name = names[index].strip() if index < len(names) and names[index].strip() else name
            part = "rotation" if axes[index].startswith("R") else "position"
            places.setdefault(f"{name}.{part}", []).append(index)
        for name, indices in places.items():
            text = next((texts[index] for index in indices if index in texts), None)
            found = {units[index].strip() if index < len(units) else "" for index in indices}
            if text is not None or len(indices) != 3 or not found <= set(_NEXUS_UNITS):
                others[name] = text or f"{len(indices)} numbers in {', '.join(sorted(found))}"
                continue
            scale = _NEXUS_UNITS[found.pop()]
            columns[name] = Column(scale * numbers[:, indices], numbers[:, 0] / rate)
    return [Episode(path.name, columns, others)], rates.pop() if len(rates) == 1 else None


def _motive(
    path: Path, rows: Iterator[list[str]], comma: bool
) -> tuple[list[Episode], float | None]:
    """The take of a Motive export, and its frames a second."""
    first = next(rows)
    properties = dict(zip(first[::2], first[1::2], strict=False))
    space = properties.get("Coordinate Space", "Global")
    if space != "Global":
        raise InvalidInputError(f"{path}: Coordinate Space must be Global, found {space[:30]!r}")
    unit = properties.get("Length Units", "Meters")
    if unit not in _UNITS:
        raise InvalidInputError(
            f"{path}: Length Units must be {' or '.join(_UNITS)}, found {unit[:30]!r}"
        )
    try:
        rate = float(properties.get("Export Frame Rate", "nan").replace(",", "."))
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
    numbers, texts = _numbers(path, rows, len(row), comma)
    places: dict[str, list[int]] = {}
    for index in range(2, len(row)):
        kind = f" ({kinds[index]})" if kinds and kinds[index].endswith("Marker") else ""
        places.setdefault(f"{names[index]}{kind}.{parts[index].lower()}", []).append(index)
    columns, others = {}, {}
    for name, indices in places.items():
        text = next((texts[index] for index in indices if index in texts), None)
        if text is not None or len(indices) > 4:
            others[name] = text or "of several bodies of one name"
            continue
        turns = name.endswith(".rotation") and len(indices) == 3
        scale = _UNITS[unit] if name.endswith(".position") else np.pi / 180.0 if turns else 1.0
        axes = "".join(row[index] for index in indices)
        axes = axes.lower() if len(axes) == 4 else properties.get("Rotation Type", "") * turns
        columns[name] = Column(scale * numbers[:, indices], numbers[:, 1], axes=axes)
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
