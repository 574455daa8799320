"""A cell as a unit of work: its command line, and, where files are not shared, its files."""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from contactgraph_studies.cell import Cell
from contactgraph_studies.parcel import Parcel, packed, unpack
from contactgraph_studies.record import Records

Execute = Callable[[list[str], Path], int]
"""Carries out a command line in the folder that one is in, writes what it says to a log file, and
tells its exit code."""


@dataclass(frozen=True)
class Errand:
    """A command line to carry out, in the study's own folder."""

    arguments: tuple[str, ...]
    folder: Path
    log: Path


@dataclass(frozen=True)
class CarriedErrand:
    """A command line to carry out, in a new folder with these files in it."""

    arguments: tuple[str, ...]
    files: Parcel
    outputs: tuple[str, ...]
    """What to bring back."""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """0: done."""
    seconds: float
    files: Parcel = ()
    """The outputs of a `CarriedErrand`."""
    said: str = ""
    """What the command of a `CarriedErrand` has printed."""


def errand_of(cell: Cell, records: Records, shares_files: bool) -> Errand | CarriedErrand:
    """Clear the way for the cell; what is to be done by somebody who sees the study's files, or
    does not."""
    arguments = records.begin(cell)
    if shares_files:
        return Errand(arguments, records.folder.absolute(), records.log_path(cell).absolute())
    read = [path for need in cell.needs for path in need.outputs]
    # A training goes on from what is in its own output.
    files = packed(records.folder, [*read, *cell.outputs])
    return CarriedErrand(arguments, files, cell.outputs)


def carry_out(errand: Errand | CarriedErrand, execute: Execute) -> Ended:
    """Do it."""
    if isinstance(errand, Errand):
        return _ended(errand.arguments, errand.folder, errand.log, execute)
    with tempfile.TemporaryDirectory(prefix="contactgraph-") as name:
        folder, log = Path(name) / "study", Path(name) / "log"
        folder.mkdir()
        unpack(errand.files, folder)
        for output in errand.outputs:
            (folder / output).parent.mkdir(parents=True, exist_ok=True)
        try:
            ended = _ended(errand.arguments, folder, log, execute)
        finally:
            os.chdir(tempfile.gettempdir())  # a folder that one is in may not be removable
        files = packed(folder, errand.outputs) if ended.code == 0 else ()
        said = log.read_text(errors="replace") if log.exists() else ""
        return Ended(ended.code, ended.seconds, files, said)


def _ended(arguments: tuple[str, ...], folder: Path, log: Path, execute: Execute) -> Ended:
    os.chdir(folder)
    began = time.perf_counter()
    code = execute(list(arguments), log)
    return Ended(code, time.perf_counter() - began)
