"""One run, or metadata, into a group of an HDF5 file."""

import h5py
import numpy as np

from contactgraph.data.dataset import Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.layout import ARRAYS, METADATA, NAMES
from contactgraph.data.trajectory import Trajectory

_ONE_CHUNK = 2**24
"""Arrays up to this many bytes are one chunk, whose address the header's checksum covers."""


def write_run(where: str, group: h5py.Group, run: Trajectory, compress: bool) -> None:
    """Fill ``group``; ``where`` names it in errors."""
    group.attrs["dt"] = float(run.scene.dt)
    write_metadata(where, group, run.scene.metadata)
    for name in NAMES:
        texts = fixed_texts(f"{where}/{name}", getattr(run.scene, name))
        _write_array(group, name, texts, compress)
    for name, field in ARRAYS.items():
        value = getattr(run if hasattr(run, name) else run.scene, name)
        if value is None:
            continue
        written = _write_array(group, name, value, compress)
        if field.unit is not None:
            written.attrs["unit"] = fixed_text(where, field.unit)


def _write_array(group: h5py.Group, name: str, value: np.ndarray, compress: bool) -> h5py.Dataset:
    # uint8, since an HDF5 bool is an enum that readers in other languages may not know.
    stored = value.astype(np.uint8) if value.dtype == bool else value
    if stored.size == 0:
        return group.create_dataset(name, data=stored)
    return group.create_dataset(
        name,
        data=stored,
        chunks=stored.shape if stored.nbytes <= _ONE_CHUNK else True,
        fletcher32=True,
        compression="gzip" if compress else None,
        shuffle=compress,
    )


def write_metadata(where: str, group: h5py.Group, metadata: Metadata) -> None:
    """Store each value as a scalar attribute of a group of its own inside ``group``."""
    attributes = group.create_group(METADATA).attrs
    for name, value in metadata.items():
        place = f"{where}: metadata {name!r}"
        if not (isinstance(name, str) and name):
            raise InvalidInputError(f"{place}: the name must be a string that is not empty")
        fixed_text(place, name)
        if isinstance(value, str):
            attributes[name] = fixed_text(place, value)
        elif isinstance(value, (bool, float, np.bool_, np.floating)):
            attributes[name] = value
        elif isinstance(value, (int, np.integer)) and -(2**63) <= value < 2**63:
            attributes[name] = np.int64(value)
        else:
            raise InvalidInputError(
                f"{place}: must be a string, int of 64 bits, float or bool, found {value!r}"
            )


def fixed_texts(where: str, texts: tuple[str, ...]) -> np.ndarray:
    """[N] UTF-8 of fixed length: texts of variable length live in a heap without checksum."""
    for text in texts:
        if not isinstance(text, str) or "\0" in text or not _is_unicode(text):
            raise InvalidInputError(f"{where}: must be Unicode without NUL, found {text!r}")
    encoded = [text.encode("utf-8") for text in texts]
    length = max([1, *(len(text) for text in encoded)])
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", length))


def fixed_text(where: str, text: str) -> np.ndarray:
    """One text as `fixed_texts` stores it."""
    return fixed_texts(where, (text,)).reshape(())


def _is_unicode(text: str) -> bool:
    """Lone surrogates are no characters, and have no UTF-8."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)
