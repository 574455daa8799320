"""Files: whether one can be read, and atomic writes, of which a reader never sees a part."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from contactgraph.data.errors import InvalidInputError


def check_readable(path: Path) -> None:
    """Raises `InvalidInputError` where ``path`` is no file, or not one that this user may read."""
    if not path.exists():
        raise InvalidInputError(f"{path}: does not exist")
    if not path.is_file():
        raise InvalidInputError(f"{path}: must be a file, found a folder or device")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"{path}: may not be read by this user")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder, which replaces ``path`` when the block ends.

    Both the file and the folder's entry reach the disk (fsync), the file before it is renamed.
    After a failure, or Ctrl-C, ``path`` is unchanged and the temporary file is gone; only a killed
    process leaves one (``.NAME.*.tmp``). Raises `InvalidInputError` where the folder does not
    exist or cannot be written to.
    """
    if not path.parent.is_dir():
        raise InvalidInputError(f"{path}: folder {path.parent} does not exist")
    if path.is_dir():
        raise InvalidInputError(f"{path}: must be a file, found a folder")
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        _flush_to_disk(temporary)
        temporary.replace(path)
        _flush_to_disk(path.parent)
    except OSError as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"{path}: cannot be written ({reason})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
