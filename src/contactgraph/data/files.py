"""Files: whether one can be read, atomic writes, and checked reading of JSON."""

import json
import os
import reprlib
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data.errors import InvalidInputError

_LARGEST_COUNT = 2**31 - 1
"""Largest integer of 32 bits."""
_LARGEST = 1e30
"""Limit of numbers, above which products overflow in single precision."""


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


@dataclass(frozen=True)
class JsonFields:
    """A JSON object from a file; ``where`` names it in errors.

    Every method gives one field's value, and raises `InvalidInputError` where it is missing or is
    not of the type that the method's name says.
    """

    where: str
    content: dict[str, Any]

    def inner(self, name: str) -> "JsonFields":
        """An object."""
        value = self._value(name)
        if not isinstance(value, dict):
            raise self._wrong(name, "an object", value)
        return JsonFields(f"{self.where}: {name}", value)

    def each(self, name: str) -> list["JsonFields"]:
        """A list of objects."""
        value = self._value(name)
        if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
            raise self._wrong(name, "a list of objects", value)
        return [
            JsonFields(f"{self.where}: {name}[{index}]", each) for index, each in enumerate(value)
        ]

    def text(self, name: str) -> str:
        """A text that is not empty."""
        value = self._value(name)
        if not isinstance(value, str) or not value:
            raise self._wrong(name, "a text", value)
        return value

    def truth(self, name: str) -> bool:
        """True or false."""
        value = self._value(name)
        if not isinstance(value, bool):
            raise self._wrong(name, "true or false", value)
        return value

    def count(self, name: str, least: int) -> int:
        """A whole number."""
        value = self._value(name)
        if not _whole(value, least):
            raise self._wrong(name, f"a whole number of at least {least}", value)
        return value

    def number(self, name: str) -> float:
        """A finite number."""
        return float(self.numbers(name, ()))

    def names(self, name: str) -> tuple[str, ...]:
        """Different texts, at least one."""
        value = self._value(name)
        texts = isinstance(value, list) and all(isinstance(each, str) and each for each in value)
        if not texts or not value or len(set(value)) != len(value):
            raise self._wrong(name, "different names, at least one", value)
        return tuple(value)

    def indices(self, name: str, count: int) -> np.ndarray:
        """[count] different whole numbers from 0 on."""
        value = self._value(name)
        whole = isinstance(value, list) and all(_whole(each, 0) for each in value)
        if not whole or len(value) != count or len(set(value)) != count:
            raise self._wrong(name, f"{count} different whole numbers from 0 on", value)
        return np.asarray(value)

    def rows(self, name: str) -> int:
        """Number of rows of a square table of any size, at least one."""
        value = self._value(name)
        if not isinstance(value, list) or not value:
            raise self._wrong(name, "rows of numbers, as many as columns", value)
        return len(value)

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """Finite numbers of a shape; None: any length of at least 1."""
        value = self._value(name)
        wanted = f"{_times(shape)} numbers" if shape else "a number"
        try:
            held = np.array(value, dtype=object)
        except ValueError as error:  # rows of different lengths
            raise self._wrong(name, wanted, value) from error
        if held.ndim != len(shape) or not all(
            found > 0 and each in (None, found)
            for found, each in zip(held.shape, shape, strict=True)
        ):
            shown = reprlib.repr(value) if held.ndim == 0 else _times(held.shape)
            raise InvalidInputError(f"{self.where}: field {name!r} must be {wanted}, found {shown}")
        for position, each in np.ndenumerate(held):
            if not _finite(each):
                where = name + "".join(f"[{index}]" for index in position)
                raise self._wrong(where, "a finite number", each)
        return held.astype(np.float64)

    def _value(self, name: str) -> Any:
        if name not in self.content:
            raise InvalidInputError(f"{self.where}: field {name!r} is missing")
        return self.content[name]

    def _wrong(self, name: str, wanted: str, found: Any) -> InvalidInputError:
        return InvalidInputError(
            f"{self.where}: field {name!r} must be {wanted}, found {reprlib.repr(found)}"
        )


def _whole(value: Any, least: int) -> bool:
    return (
        isinstance(value, int) and not isinstance(value, bool) and least <= value <= _LARGEST_COUNT
    )


def _times(shape: tuple[int | None, ...]) -> str:
    return " x ".join("1 or more" if each is None else str(each) for each in shape)


def _finite(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and abs(value) < _LARGEST


def parse_json(text: str) -> Any:
    """The content of a JSON text; raises `ValueError` also for NaN and infinity."""
    return json.loads(text, parse_constant=_refuse_constant)


def read_json_fields(
    path: Path, what: str, file_format: str, version: int, size_limit: int
) -> JsonFields:
    """The fields of ``what``, such as "a cost file"; nothing in the file is executed.

    Raises `InvalidInputError` unless it is JSON of this format and version, within the limit.
    """
    check_readable(path)
    if path.stat().st_size > size_limit:
        raise InvalidInputError(f"{path}: must be {what}, of at most {size_limit} bytes")
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"{path}: must be {what} (JSON), found something else or a damaged file ({reason})"
        ) from error
    if not isinstance(content, dict) or content.get("format") != file_format:
        raise InvalidInputError(f"{path}: must be {what}, whose 'format' is {file_format!r}")
    found = content.get("format_version")
    if found != version or isinstance(found, bool):
        raise InvalidInputError(
            f"{path}: field 'format_version' must be {version}, found {found!r}"
        )
    return JsonFields(str(path), content)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"numbers must be finite, found {name}")
