"""Files and folders as values, to be carried to where they cannot be read, and back."""

from collections.abc import Iterable
from pathlib import Path

Parcel = tuple[tuple[str, bytes], ...]
"""Paths, relative to a folder, and contents."""


def packed(folder: Path, paths: Iterable[str]) -> Parcel:
    """Those of the files, and of all files in those of the folders, that are there."""
    found: dict[str, bytes] = {}
    for path in paths:
        top = folder / path
        for file in sorted(top.rglob("*")) if top.is_dir() else [top]:
            if file.is_file():
                found[file.relative_to(folder).as_posix()] = file.read_bytes()
    return tuple(found.items())


def unpack(parcel: Parcel, folder: Path) -> None:
    """Write the files."""
    for path, content in parcel:
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
