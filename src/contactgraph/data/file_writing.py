"""Writes trajectories to HDF5 files in the layout of docs/file-format.md."""

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import cast

import h5py
import numpy as np

from contactgraph.data.atomic_file import atomic_write
from contactgraph.data.dataset import Dataset, Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.file_layout import (
    ARRAYS,
    CONTROL_KIND,
    FIELD_OF,
    FORMAT,
    METADATA,
    NAMES,
    TRAJECTORIES,
    VERSION,
)
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory

_ONE_CHUNK = 2**24
"""Arrays up to this many bytes are one chunk, whose address the header's checksum covers."""
_OF_SCENE = {each.name for each in fields(Scene)}


def write_trajectories(
    path: str | Path,
    trajectories: Iterable[Trajectory],
    metadata: Metadata | None = None,
    compress: bool = False,
) -> None:
    """Write trajectories to ``path`` atomically: a reader sees the old file or the whole new one.

    Without ``metadata`` those of a `Dataset` are kept. Raises `InvalidInputError` where
    trajectories disagree (see `Dataset`), a name or a metadata value cannot be stored, or the
    folder cannot be written to. `contactgraph.write` is this, `contactgraph.read` its inverse.

    >>> import tempfile
    >>> import contactgraph
    >>> from contactgraph.data import Scene
    >>> scene = Scene(("hand", "box"), ("hand", "object"), actuated=[True, False], dt=0.05)
    >>> still = np.zeros((11, 2, 2))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     contactgraph.write(f"{folder}/mine.h5", [Trajectory(scene, still, still, still[1:, 0])])
    ...     contactgraph.read(f"{folder}/mine.h5")
    Dataset(1 trajectories, T=10, N=2, D=2, U=2, dt=0.05 s)
    """
    path = Path(path)
    kept = trajectories.metadata if isinstance(trajectories, Dataset) else {}
    dataset = Dataset(tuple(trajectories), kept if metadata is None else metadata)
    with (
        atomic_write(path) as temporary,
        # From v110 on all structure has checksums, so that damage is detected.
        h5py.File(temporary, "x", libver=("v110", "v110")) as file,
    ):
        file.attrs["format"] = _fixed_text(str(path), FORMAT)
        file.attrs["format_version"] = VERSION
        _write_metadata(str(path), file, dataset.metadata)
        groups = file.create_group(TRAJECTORIES)
        for index, each in enumerate(dataset):
            name = f"{index:06d}"
            where = f"{path}: {TRAJECTORIES}/{name}"
            _write_trajectory(where, groups.create_group(name), each, compress)


def _write_trajectory(
    where: str, group: h5py.Group, trajectory: Trajectory, compress: bool
) -> None:
    """Fill ``group``; ``where`` names it in errors."""
    group.attrs["dt"] = float(trajectory.scene.dt)
    _write_metadata(where, group, trajectory.scene.metadata)
    scene = trajectory.scene
    names: dict[str, tuple[str, ...]] = {name: getattr(scene, name) for name in NAMES}
    if scene.control_kind is not None:
        names[CONTROL_KIND] = scene.control_kind
    for name, texts in names.items():
        _write_array(group, name, _fixed_texts(f"{where}/{name}", texts), compress)
    for name, field in ARRAYS.items():
        value = _stored(trajectory, name)
        if value is None:
            continue
        written = _write_array(group, name, value, compress)
        unit = (
            None if name == "control" and set(scene.control_kind or ()) - {"force"} else field.unit
        )
        if unit is not None:
            written.attrs["unit"] = _fixed_text(where, unit)


def _stored(trajectory: Trajectory, name: str) -> np.ndarray | None:
    """The array ``name`` of a file; None where the trajectory has none."""
    scene = trajectory.scene
    if name == "polygons":
        return (
            None
            if scene.polygons is None
            else np.concatenate([np.empty((0, scene.dimension)), *scene.polygons])
        )
    if name == "polygon_size":
        sizes = None if scene.polygons is None else [len(each) for each in scene.polygons]
        return None if sizes is None else np.array(sizes, dtype=np.int64)
    found = getattr(scene if name in _OF_SCENE else trajectory, FIELD_OF.get(name, name))
    return cast(np.ndarray | None, found)


def _write_array(group: h5py.Group, name: str, value: np.ndarray, compress: bool) -> h5py.Dataset:
    # uint8, because an HDF5 bool is an enum that readers in other languages may not know.
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


def _write_metadata(where: str, group: h5py.Group, metadata: Metadata) -> None:
    """Store each value as a scalar attribute of a subgroup of ``group``."""
    attributes = group.create_group(METADATA).attrs
    for name, value in metadata.items():
        entry = f"{where}: metadata {name!r}"
        if not (isinstance(name, str) and name):
            raise InvalidInputError(f"{entry}: the name must be a string that is not empty")
        _fixed_text(entry, name)
        if isinstance(value, str):
            attributes[name] = _fixed_text(entry, value)
        elif isinstance(value, (bool, float, np.bool_, np.floating)):
            attributes[name] = value
        elif isinstance(value, (int, np.integer)) and -(2**63) <= value < 2**63:
            attributes[name] = np.int64(value)
        else:
            raise InvalidInputError(
                f"{entry}: must be a string, int of 64 bits, float or bool, found {value!r}"
            )


def _fixed_texts(where: str, texts: tuple[str, ...]) -> np.ndarray:
    """[N] UTF-8 of fixed length, because texts of variable length are stored without checksum."""
    for text in texts:
        # Lone surrogates are no characters, and have no UTF-8.
        if not isinstance(text, str) or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in text):
            raise InvalidInputError(f"{where}: must be Unicode without NUL, found {text!r}")
    encoded = [text.encode("utf-8") for text in texts]
    length = max([1, *(len(text) for text in encoded)])
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", length))


def _fixed_text(where: str, text: str) -> np.ndarray:
    return _fixed_texts(where, (text,)).reshape(())
