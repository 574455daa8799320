"""Safe reading of HDF5 files that may be damaged or hostile.

Every h5py error becomes one `InvalidInputError` with the location. No link to another file is
followed, nothing is executed, and no array is read that is larger than the file can contain. Texts
of variable length are refused: libhdf5 hangs, allocates gigabytes or crashes on damage to the heap
that contains them (about 1 in 300 files with random bytes flipped; without such texts none of
20,000).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.schema import Field

_DEFLATE_LIMIT = 1100
"""One byte stored by deflate never expands to more than this many."""
_UNPACKED_LIMIT = 2**30
"""Largest size of an unpacked array, bytes, that is larger than in the file."""
_TEXT_LIMIT = 2**20
"""Largest size of one text, bytes."""
_KINDS = {
    float: ("fiu", "floats or integers"),
    bool: ("biu", "bools, or integers 0 and 1"),
    int: ("iu", "integers"),
    str: ("S", "UTF-8 texts of fixed length, like np.array([b'gripper'])"),
}
"""NumPy's letters for the types that are read as the kinds of `Field`, and their description."""
_BUILT_IN_FILTERS = frozenset({1, 2, 3, 4, 5, 6, 32000})
"""Deflate, shuffle, fletcher32, szip, nbit, scaleoffset, lzf; others would load a plug-in."""


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Turns any failure inside into an `InvalidInputError` that starts with ``where``."""
    try:
        yield
    except InvalidInputError:
        raise
    except Exception as error:  # h5py raises nearly every built-in type on damaged files
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InvalidInputError(
            f"{where}: cannot be read, the file is damaged ({reason})"
        ) from error


@contextmanager
def opened(path: Path, expected: str = "HDF5, or is damaged") -> Iterator["UntrustedGroup"]:
    """The root of a file, which must be what is ``expected``."""
    with reading(str(path)):
        if not h5py.is_hdf5(path):
            raise InvalidInputError(f"{path}: must be {expected}")
        with h5py.File(path, "r", locking="best-effort") as file:
            yield UntrustedGroup(str(path), file)


@dataclass(frozen=True)
class UntrustedGroup:
    """A group of an HDF5 file, with ``where`` to name it in errors."""

    where: str
    group: h5py.Group

    def names(self) -> list[str]:
        """Names of the group's members."""
        with reading(self.where):
            return list(self.group)

    def names_by_number(self) -> list[str]:
        """Names of the group's members, which must be numbers, in numerical order."""
        names = self.names()
        for name in names:
            if not (name.isascii() and name.isdigit()):
                raise InvalidInputError(
                    f"{self.where}: must hold groups named 000000, 000001, …, found {name!r}"
                )
        return sorted(names, key=int)

    def is_group(self, name: str) -> bool:
        """Whether ``name`` is a group inside this one, and no array."""
        with reading(self._at(name)):
            return isinstance(self._open(name), h5py.Group)

    def child(self, name: str) -> "UntrustedGroup":
        """The group ``name`` inside this one."""
        where = self._at(name)
        with reading(where):
            found = self._open(name)
            if not isinstance(found, h5py.Group):
                raise InvalidInputError(f"{where}: must be a group, found an array")
            return UntrustedGroup(where, found)

    def array(self, name: str, field: Field) -> Any:
        """The array or the texts ``name``, after a check of its rank, type, unit and size."""
        where = self._at(name)
        with reading(where):
            found = self._dataset(name)
            kinds, words = _KINDS[field.kind]
            if found.dtype.kind not in kinds or found.ndim != len(field.axis):
                raise InvalidInputError(
                    f"{where}: must have shape {field.shape} of {words}, "
                    f"found {_kind(found.dtype)} in shape {found.shape}"
                )
            unit = _scalar(where, found.attrs, "unit") if "unit" in found.attrs else field.unit
            if unit != field.unit:
                raise InvalidInputError(f"{where}: unit must be {field.unit}, found {unit}")
            value = found[...]
            if field.kind is str:
                return tuple(text.decode("utf-8") for text in value)
            if field.kind is bool and not np.isin(value, (0, 1)).all():
                raise InvalidInputError(f"{where}: must hold only 0 and 1")
            return value

    def numbers(self, name: str) -> np.ndarray | str:
        """The array ``name`` of numbers or bools of any shape; a text says what else is there."""
        with reading(self._at(name)):
            found = self._dataset(name)
            if found.dtype.kind not in "biuf" or not found.ndim:
                return f"{_kind(found.dtype)} in shape {found.shape}"
            return found[...]

    def attribute(self, name: str) -> str | int | float | bool:
        """The scalar attribute ``name``."""
        where = f"{self.where}: attribute {name!r}"
        with reading(where):
            return _scalar(where, self.group.attrs, name)

    def attributes(self) -> dict[str, str | int | float | bool]:
        """All attributes, each a scalar."""
        with reading(self.where):
            names = list(self.group.attrs)
        return {name: self.attribute(name) for name in names}

    def _at(self, name: str) -> str:
        return f"{self.where}/{name}" if self.group.name != "/" else f"{self.where}: {name}"

    def _open(self, name: str) -> h5py.Group | h5py.Dataset:
        where = self._at(name)
        if name not in self.names():
            raise InvalidInputError(f"{where}: is missing")
        if not isinstance(self.group.get(name, getlink=True), h5py.HardLink):
            raise InvalidInputError(f"{where}: must be stored here, found a link to elsewhere")
        return self.group[name]

    def _dataset(self, name: str) -> h5py.Dataset:
        where = self._at(name)
        found = self._open(name)
        if not isinstance(found, h5py.Dataset):
            raise InvalidInputError(f"{where}: must be an array, found {type(found).__name__}")
        if found.external or found.is_virtual:
            raise InvalidInputError(f"{where}: must be stored here, found data in another file")
        plan = found.id.get_create_plist()
        filters = {plan.get_filter(i)[0] for i in range(plan.get_nfilters())}
        if filters - _BUILT_IN_FILTERS:
            raise InvalidInputError(f"{where}: must be compressed by gzip, lzf or not at all")
        stored = found.id.get_storage_size()
        needed = max(prod(found.shape or (1,)), prod(found.chunks or (1,))) * found.dtype.itemsize
        if found.size and needed > stored:
            limit = min(_UNPACKED_LIMIT, _DEFLATE_LIMIT * stored) if filters else stored
            if needed > limit:
                raise InvalidInputError(
                    f"{where}: declares shape {found.shape} ({needed} bytes), "
                    f"but the file holds {stored} bytes of it"
                )
        return found


def _scalar(where: str, attributes: h5py.AttributeManager, name: str) -> str | int | float | bool:
    if name not in attributes:
        raise InvalidInputError(f"{where}: is missing")
    stored = attributes.get_id(name)
    known = stored.dtype.kind in "Sbiuf" and stored.dtype.itemsize <= _TEXT_LIMIT
    if stored.shape != () or not known:
        raise InvalidInputError(
            f"{where}: must be one int, float, bool or text of fixed length (np.bytes_), "
            f"found {_kind(stored.dtype)} in shape {stored.shape}"
        )
    if stored.dtype.kind == "f":
        return float(attributes[name])
    value = attributes[name].item()
    return value.decode("utf-8") if isinstance(value, bytes) else value


def _kind(dtype: np.dtype) -> str:
    text = h5py.check_string_dtype(dtype)
    return "text of variable length" if text is not None and text.length is None else str(dtype)
