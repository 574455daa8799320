"""Output of commands: files, progress, and the versions that a result was made with."""

import contextlib
import hashlib
import json
import math
import platform
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich import progress as rich_progress
from rich.console import Console

from contactgraph.data import InvalidInputError, atomic_write


def check_writable(path: Path | None) -> None:
    """Refuse, before any work is done, a file that could not be written in the end."""
    if path is None:
        return
    if path.is_dir():
        raise InvalidInputError(f"{path}: must be a file, found a folder")
    if not path.absolute().parent.is_dir():
        raise InvalidInputError(f"{path}: folder {path.parent} does not exist")


def check_suffix(flag: str, path: Path | None, suffix: str) -> None:
    """Refuse a path with another suffix."""
    if path is not None and path.suffix.lower() != suffix:
        raise InvalidInputError(f"{flag} must name a file that ends in {suffix}, found {path}")


def write_json(path: Path | None, values: Mapping[str, Any]) -> None:
    """Write a JSON object to a file, atomically; nothing without a path.

    Numbers that are not finite become null, since JSON has none.
    """
    if path is None:
        return
    write_text(path, json.dumps(_finite(values), indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class Progress:
    """Progress over ``total`` steps, as a plain line on stderr after every tenth of them."""

    def __init__(self, title: str, total: int) -> None:
        self._title, self._total, self._printed = title, total, 0.0

    def advance(self, done: int, note: str = "") -> None:
        """Report that ``done`` steps are complete; ``note`` is a short status text."""
        fraction = done / self._total
        if fraction >= self._printed + 0.1 or done == self._total:
            self._printed = fraction
            print(f"{self._title}: {done} of {self._total} {note}".rstrip(), file=sys.stderr)


class _ProgressBar(Progress):
    """The same as a bar with an estimate of the remaining time."""

    def __init__(self, bar: rich_progress.Progress, task: rich_progress.TaskID) -> None:
        self._bar, self._task = bar, task

    def advance(self, done: int, note: str = "") -> None:
        self._bar.update(self._task, completed=done, note=note)


@contextmanager
def progress(title: str, total: int) -> Iterator[Progress]:
    """A progress bar on a terminal, `Progress` lines elsewhere; both on stderr."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Progress(title, total)
        return
    columns = (
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
        rich_progress.TextColumn("{task.fields[note]}"),
    )
    with rich_progress.Progress(*columns, console=console) as bar:
        yield _ProgressBar(bar, bar.add_task(title, total=total, note=""))


_PACKAGES = ("contactgraph", "jax", "equinox", "optax", "numpy", "box2d", "mujoco")


def provenance() -> dict[str, dict[str, str]]:
    """Versions of Python and of the packages that shape a result; of MuJoCo where it is there."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return {"versions": found}


def sha256(path: Path) -> str:
    """The file's fingerprint."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
