"""The gate of a change: the numbers of one state in one file, and what is worse than in another."""

import csv
import hashlib
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import contactgraph
from contactgraph.cli.output import provenance, write_json
from contactgraph.data import InvalidInputError
from contactgraph.evaluate import number_or_word
from contactgraph_studies.data_sets import Source
from contactgraph_studies.results_study import QUANTITIES, ResultRow

VERSION = 1
"""Of the file's format."""

_BASELINES = ("constant_velocity", "least_squares", "network", "fixed", "prior", "expert")
_BETTER_IF_HIGH = ("edge_f1", "success", "turned_over", "mass_coverage")
_LEAST_NOISE = {"cm": 0.1, "degrees": 0.1, "mm": 0.2, "s": 0.3, "p50": 0.3, "p99": 0.5}
"""Share of the earlier number that counts as noise at least, by the end of a column's name."""
_LEAST_DIFFERENCE = {"cm": 0.005, "degrees": 0.05, "mm": 0.01, "s": 5.0, "p50": 0.5, "p99": 2.0}
"""The same in the column's unit."""
_LEAST_OF_SHARES = 0.01
"""The same of F1 and calibration errors, which have no unit."""

Numbers = Mapping[str, Mapping[str, float]]
"""By row and column; unknown numbers are left out."""


def sources_digest() -> str:
    """Hash of the library's Python files, which tells one state from another."""
    root = Path(str(files(contactgraph)))
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def write_gate(path: Path, rows: Sequence[ResultRow]) -> None:
    """One JSON file: format, state, versions, and the known medians by row and column."""
    numbers = {
        row.name: {
            name: number_or_word(one.median) for name, one in row.numbers.items() if one.known
        }
        for row in rows
    }
    successes = {row.name: row.results.success(row.condition(Source.mpc)) for row in rows}
    write_json(
        path,
        {
            "gate": VERSION,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "sources": sources_digest(),
            **provenance(),
            "episodes": {name: one.trials[1] for name, one in successes.items() if one is not None},
            "numbers": numbers,
        },
    )


def read_gate(path: Path) -> dict[str, Any]:
    """The contents of a file by `write_gate`. Raises `InvalidInputError` for any other file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(f"--against: {path}: {error.strerror}") from error
    except ValueError as error:
        raise InvalidInputError(f"--against: {path} is no JSON file") from error
    found = content.get("gate") if isinstance(content, dict) else None
    foreign = f"--against: {path} must be a file of reproduce results --gate"
    if found is None:
        raise InvalidInputError(foreign)
    if found != VERSION:
        raise InvalidInputError(
            f"--against: {path} has version {found} of the gate's file, this program compares "
            f"version {VERSION}: measure that state again"
        )
    try:
        content["numbers"] = {
            row: {name: math.inf if one == "infinite" else float(one) for name, one in each.items()}
            for row, each in content["numbers"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(foreign) from error
    return content


def spreads(path: Path) -> dict[str, dict[str, float]]:
    """The range over trainings of every number of a table of results (CSV); empty without it."""
    if not path.is_file():
        return {}
    found: dict[str, dict[str, float]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for cells in csv.DictReader(file):
            ends = {
                name: (cells.get(f"{name}_low"), cells.get(f"{name}_high")) for name in QUANTITIES
            }
            found[cells["row"]] = {
                name: float(high) - float(low) for name, (low, high) in ends.items() if low and high
            }
    return found


def compare(before: Mapping[str, Any], after: Mapping[str, Any], spread: Numbers) -> Iterator[str]:
    """A line for what is worse by more than the noise between trainings, or not measured now."""
    for row, numbers in before["numbers"].items():
        now = after["numbers"].get(row, {})
        for name, old in numbers.items():
            if name.startswith(_BASELINES) or name not in QUANTITIES:
                continue
            if name not in now:
                yield f"{row}: {name}: {old:.3g} before, not measured now"
                continue
            episodes = [each.get("episodes", {}).get(row) for each in (before, after)]
            noise = _noise(name, old, spread.get(row, {}).get(name, 0.0), episodes)
            gain = now[name] - old if name.startswith(_BETTER_IF_HIGH) else old - now[name]
            if gain < -noise:  # never where both are infinite
                change = f"{old:.3g} before, {now[name]:.3g} now"
                yield f"{row}: {name}: {change} (noise {noise:.2g})"


def _noise(name: str, old: float, spread: float, episodes: Sequence[int | None]) -> float:
    end = name.rpartition("_")[2]
    if name == "success_percent":
        counts = [count for count in episodes if count]
        share = min(max(old / 100.0, 0.05), 0.95)
        variance = sum(share * (1.0 - share) / count for count in counts)
        return max(spread, 100.0 * 2.0 * math.sqrt(variance))
    if end == "percent":
        return max(spread, 2.0)
    if end in _LEAST_NOISE:
        least = _LEAST_NOISE[end] * old if math.isfinite(old) else 0.0
        return max(spread, least, _LEAST_DIFFERENCE[end])
    return max(spread, _LEAST_OF_SHARES)
