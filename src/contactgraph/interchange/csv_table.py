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
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import chain, islice, takewhile, zip_longest
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
_TIME = re.compile(
    r"[%_]*(?:t|(?i:time(?:stamp)?|elapsed|seconds|temps|tiempo|zeit)"
    r"(?:[ _]*[(\[]?(?P<unit>s|sec|seconds|ms|us|ns)[)\]]?)?)"
)
_LIKE_TIME = re.compile(r"(?i:time|stamp|date|clock|temps|tiempo|zeit)")
_SECONDS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_FRAMES = ("frame", "frame_index", "frame_number")
_EPISODE = "episode"
_ENDS = ("terminated", "truncated", "terminal", "done", "terminations", "truncations", "dones")
"""Columns that tell the last row of an episode."""
_QUATERNION_PART = re.compile(r"(?i:(?:.*[._ ]q?|q)[wxyz])")
_NEXUS = ("Trajectories", "Segments", "Joints", "Devices", "Model Outputs")
_MOTIVE_UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
_SI = {"m": 1.0, "cm": 0.01, "mm": 0.001, "deg": np.pi / 180.0, "rad": 1.0, "1": 1.0}
_Labels = list[tuple[str, str, str]]  # names, axes and units of columns


@dataclass(frozen=True)
class _Table:
    """The rows of a file from some row on, and whether numbers may have a comma for a point."""

    path: Path
    rows: Iterator[list[str]]
    decimal_comma: bool

    def error(self, reason: str) -> InvalidInputError:
        return InvalidInputError(f"{self.path}: {reason}")

    def read(
        self, width: int, kept: Sequence[int] = (), blank: bool = True
    ) -> tuple[np.ndarray, dict[int, str], dict[int, list[str]]]:
        """Numbers [S, W], NaN for empty fields and texts; the first text of each column that has
        one; and all fields of the columns ``kept``. ``blank``: rows with nothing count."""
        if width > _MOST_COLUMNS:
            raise self.error(f"must have at most {_MOST_COLUMNS} columns")
        found: list[np.ndarray] = []
        texts: dict[int, str] = {}
        fields: dict[int, list[str]] = {index: [] for index in kept}
        marks: set[str] = set()
        end = 0
        for number, row in enumerate(self.rows, start=1):
            if not row or not (blank or any(row)):
                continue
            while len(row) > width and not row[-1].strip():
                row.pop()
            if len(row) != width:
                raise self.error(f"row {number} must have {width} fields, found {len(row)}")
            check_count(str(self.path), len(found) * width)
            values = [_number(each, self.decimal_comma) for each in row]
            found.append(np.array(values, dtype=np.float64))
            for index, each in enumerate(row):
                if values[index] is None:
                    texts.setdefault(index, f"{each[:30]!r} in row {number}")
                elif self.decimal_comma:
                    marks |= {mark for mark in ".," if mark in each}
            for index in kept:
                fields[index].append(row[index])
            end = len(found) if any(row) else end
        if not end:
            raise self.error("must have rows of numbers, found none")
        if len(marks) > 1:
            raise self.error("numbers must all have a decimal point, or all a comma")
        return np.stack(found[:end]), texts, fields


def _number(text: str, decimal_comma: bool = True) -> float | None:
    """NaN for an empty field, None for a text other than true and false."""
    try:
        text = text.replace(",", ".") if decimal_comma else text
        return float(text.replace("_", "text")) if text.strip() else np.nan  # 1_5 is a text
    except ValueError:
        return {"true": 1.0, "false": 0.0}.get(text.strip().lower())


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
            found, found_rates = _read_file(path)
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            reason = " ".join(str(error).split())[:200]
            message = f"{path}: must be CSV in UTF-8, or is damaged ({reason})"
            raise InvalidInputError(message) from error
        count += sum(c.values.size for each in found for c in each.columns.values())
        check_count(str(source), count)
        episodes += found
        rates |= found_rates
    rate = rates.pop() if len(rates) == 1 else None
    return Recording(str(source), tuple(episodes), dt=1.0 / rate if rate and rate > 0.0 else None)


def _read_file(path: Path) -> tuple[list[Episode], set[float | None]]:
    """The episodes of a file, and its rows a second, where it tells them."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        delimiter = comment = first = ""
        for first in file:
            if first[:4].lower() == "sep=":
                delimiter = first[4:5].strip('\r\n"')
            elif first.startswith("#"):
                comment = first[1:]
            else:
                break
        delimiter = delimiter or max(",;\t", key=first.count)
        if delimiter not in first and " " in first and first.strip() not in _NEXUS:
            delimiter = " "
        rows = csv.reader(chain([first], file), delimiter=delimiter, skipinitialspace=True)
        table = _Table(path, rows, delimiter != ",")
        if first.lstrip('"').startswith("Format Version"):
            return _motive(table)
        if first.strip(f'"\r\n{delimiter}') in _NEXUS:
            return _nexus(table)
        return _plain(table, comment.strip().split(delimiter)), {None}


def _plain(table: _Table, comment: list[str]) -> list[Episode]:
    """The episodes of a table with names in the first row, or in the comment above."""
    row = next(table.rows, [])
    numbers = " ".join(row).split()
    if numbers and None not in map(_number, numbers):
        if not len(comment) == len(row) == len(numbers):
            raise table.error(
                "must begin with a line of names, separated by a comma, semicolon, tab or space, "
                f"found numbers: {numbers[0][:30]!r}"
            )
        table, row = replace(table, rows=chain([row], table.rows)), comment
    names = [each.strip() for each in row]
    while names and not names[-1]:
        names.pop()
    if names and not names[0]:
        names[0] = "index"  # of a data frame
    if not names or not all(names) or len(set(names)) != len(names):
        raise table.error(f"must begin with a line of different names, found {names}")
    clocks = {index: match for index, name in enumerate(names) if (match := _TIME.fullmatch(name))}
    time = min(clocks, key=lambda index: (names[index].lower() != "time", index), default=None)
    label = next((index for index, name in enumerate(names) if name.lower() == _EPISODE), None)
    kept = [index for index in (time, label) if index is not None]
    ends = [index for index, name in enumerate(names) if label is None and name.lower() in _ENDS]
    values, texts, fields = table.read(len(names), kept + ends, blank=not kept)
    stamps, no_times = None, ""
    if time is not None:
        scale = _SECONDS.get(clocks[time]["unit"], 1.0)
        try:
            if time in texts:
                times = [datetime.fromisoformat(text.strip()) for text in fields[time]]
                values[:, time] = [(each - times[0]).total_seconds() / scale for each in times]
                del texts[time]
            stamps = scale * values[:, time]
        except (ValueError, TypeError):
            no_times = f"column {names[time]!r} must be s or ISO 8601 times, found {texts[time]}"
            kept.remove(time)
    others = {names[index]: text for index, text in texts.items()}
    axes = {name: name[-1].lower() for name in names if _QUATERNION_PART.fullmatch(name)}
    there = {name: index for index, name in enumerate(names) if index not in texts}
    frame = next((there[name] for name in _FRAMES if name in there), None)
    ended = np.zeros(len(values), dtype=int)
    for index in ends:
        ended |= [each.strip().lower() in ("true", "1", "1.0") for each in fields[index]]
    labels = list(map(str, np.cumsum(ended) - ended)) if label is None else fields[label]
    if any(labels) and not all(labels):
        blank = labels.index("") + 1
        raise table.error(f"{_EPISODE} must be in every row of numbers, found none in row {blank}")
    rows_of: dict[str, list[int]] = {}
    for index, text in enumerate(labels):
        rows_of.setdefault(text, []).append(index)
    episodes: list[Episode] = []
    for text, rows in rows_of.items():
        own = None if stamps is None else stamps[rows]
        columns = {
            name: Column(values[rows, index, None], own, axes=axes.get(name, ""))
            for name, index in there.items()
        }
        steps, lack = None, no_times
        if stamps is None and frame is not None:
            number = values[rows, frame]
            apart = np.diff(number)
            if (back := np.flatnonzero(apart <= 0.0)).size:
                at = number[back[0]]
                lack = f"{names[frame]} must increase from row to row, but not after {at:g}"
            whole = np.all((apart >= 1.0) & (apart == np.round(apart)))
            if whole and 2 * np.sum(apart == 1.0) > len(apart):  # of which some are missing
                steps = number - number[0]
        elif stamps is None:
            lack = no_times or _unused_times(names, values[rows], texts)
        title = table.path.name + f": {_EPISODE} {text}" * bool(text and len(rows_of) > 1)
        used = {names[index] for index in kept + ends}
        episodes.append(Episode(title, columns, others, lack, used, steps))
    return episodes


def _unused_times(names: list[str], values: np.ndarray, texts: dict[int, str]) -> str:
    """Why rows [S, W] are not taken as even: a column may time or count them; empty: none does."""
    for index, name in enumerate(names):
        apart = np.diff(values[:, index])
        uneven = np.all(apart >= 0.0) and not np.allclose(apart, apart[:1], rtol=0.01)
        counts = uneven and np.all(apart % 1.0 == 0.0) and apart.min() == 1.0 == np.median(apart)
        if counts or (_LIKE_TIME.search(name) and (uneven or index in texts)):
            return (
                f"column {name!r} may time or count uneven rows: name it time (s, or ISO 8601 "
                "texts) or frame, give [time] columns, or leave it out"
            )
    return ""


def _nexus(table: _Table) -> tuple[list[Episode], set[float | None]]:
    """The trial of an export of Vicon Nexus, and its frames a second."""
    episode = Episode(table.path.name, {})
    rates: set[float | None] = set()
    for kind in filter(any, table.rows):
        (rate_text, *_), names, axes, units = (next(table.rows, []) or [""] for _ in range(4))
        section = replace(table, rows=iter(list(takewhile(any, table.rows))))
        if kind[0] not in _NEXUS[:2]:
            episode.others[kind[0]] = "of Nexus, beside trajectories and segments"
            continue
        axes = list(takewhile(bool, axes))  # Excel adds empty ones
        rate = _number(rate_text, False) or np.nan
        if not rate > 0.0 or axes[:2] != ["Frame", "Sub Frame"]:
            raise table.error(
                f"{kind[0]} must have lines of rate, names, axes from Frame and Sub Frame on, units"
            )
        rates.add(rate)
        labels: _Labels = []
        name = ""
        for text, axis, unit in islice(zip_longest(names, axes, units, fillvalue=""), len(axes)):
            name = text.strip() or name
            part = "rotation" if axis.startswith("R") else "position"
            labels.append((f"{name}.{part}", axis, unit.strip()))
        _add(episode, section, labels, rate)
    return [episode], rates


def _motive(table: _Table) -> tuple[list[Episode], set[float | None]]:
    """The take of a Motive export, and its frames a second."""
    first = next(table.rows)
    properties = dict(zip(first[::2], first[1::2], strict=False))
    space = properties.get("Coordinate Space", "Global")
    if space != "Global":
        raise table.error(f"Coordinate Space must be Global, found {space[:30]!r}")
    unit = properties.get("Length Units", "Meters")
    if unit not in _MOTIVE_UNITS:
        raise table.error(f"Length Units must be {' or '.join(_MOTIVE_UNITS)}, found {unit[:30]!r}")
    header = [next(table.rows, [])]
    while header[-1][:1] != ["Frame"] and len(header) <= _HEADER_ROWS:
        header.append(next(table.rows, []))
    axes = header.pop()
    if axes[:1] != ["Frame"] or len(axes) < 2:
        raise table.error("must have a line of axes that begins with Frame")
    labelled = {each[1]: each for each in header if len(each) > 1 and each[1]}
    kinds, names = labelled.get("Type", axes), labelled.get("Name", [])
    parts = next((each for each in reversed(header) if len(each) > 2 and not each[1]), [])
    if min(map(len, (names, parts, kinds))) < len(axes):
        raise table.error("must have lines of Name and of Rotation and Position")
    unit_of = {"position": _MOTIVE_UNITS[unit]}
    labels: _Labels = []
    for name, kind, part, axis in zip(names, kinds, parts, axes, strict=False):
        body = f"{name} ({kind})" if kind.endswith("Marker") else name
        labels.append((f"{body}.{part.lower()}", axis, unit_of.get(part.lower(), "1")))
    episode = Episode(table.path.name, {})
    _add(episode, table, labels, euler=properties.get("Rotation Type", ""))
    return [episode], {_number(properties.get("Export Frame Rate", ""))}


def _add(
    episode: Episode, table: _Table, labels: _Labels, rate: float | None = None, euler: str = ""
) -> None:
    """Adds a column in SI units for each name; the first two of all are the frame and its time."""
    values, texts, _ = table.read(len(labels))
    stamps = values[:, 1] if rate is None else values[:, 0] / rate
    groups: dict[str, list[int]] = {}
    for index in range(2, len(labels)):
        groups.setdefault(labels[index][0], []).append(index)
    for name, group in groups.items():
        _, axes, units = zip(*(labels[index] for index in group), strict=True)
        text = next((texts[index] for index in group if index in texts), "")
        if text or len(set(axes)) < len(axes) or not set(units) <= set(_SI):
            episode.others[name] = text or f"{len(axes)} numbers in {', '.join(sorted(set(units)))}"
            continue
        angles = euler if name.endswith(".rotation") else ""
        order = "".join(axes).lower() if len(axes) == 4 else angles
        scale = [_SI[unit] for unit in units]
        episode.columns[name] = Column(values[:, group] * scale, stamps, axes=order)


def write_csv(layout: ExportLayout, folder: Path) -> None:
    """Writes a file for each trajectory to a new folder; the last row has no control."""
    names = ["time", *layout.names, *layout.control_names]
    with new_folder(folder) as temporary:
        for index, each in enumerate(layout.dataset):
            times = each.scene.dt * np.arange(each.steps + 1)
            states = np.column_stack([times, layout.states(each)])
            control = [*each.control.tolist(), [""] * layout.dataset.control_size]
            path = temporary / f"{_EPISODE}-{index:06d}.csv"
            with path.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(names)
                for state, action in zip(states.tolist(), control, strict=True):
                    writer.writerow([*("" if each != each else each for each in state), *action])
        text = layout.map_text(
            lambda start, stop: json.dumps(layout.names[start:stop], ensure_ascii=False),
            lambda start, stop: json.dumps(layout.control_names[start:stop], ensure_ascii=False),
        )
        (temporary / MAP_FILE).write_text(text, encoding="utf-8")
