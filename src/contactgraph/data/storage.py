"""Dataset files: HDF5 in the layout of docs/file-format.md."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from contactgraph.data.atomic_file import atomic_write
from contactgraph.data.dataset import Dataset, Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.trajectory import Scene, Trajectory
from contactgraph.data.untrusted_hdf5 import (
    ARRAYS,
    FORMAT,
    METADATA,
    NAMES,
    OPTIONAL,
    TRAJECTORIES,
    VERSION,
    UntrustedGroup,
    reading,
)

_ONE_CHUNK = 2**24
"""Arrays up to this many bytes are one chunk, whose address the header's checksum covers."""
_OF_SCENE = {each.name for each in fields(Scene)}
_ATTRIBUTES = {"skeleton": "link_positions"}
"""Arrays whose attribute of `Trajectory` has another name."""


def write_trajectories(
    path: str | Path,
    trajectories: Sequence[Trajectory],
    metadata: Metadata | None = None,
    compress: bool = False,
) -> None:
    """Write trajectories to ``path`` atomically: a reader sees the old file or the whole new one.

    Raises `InvalidInputError` where trajectories disagree (see `Dataset`), a name or a metadata
    value cannot be stored, or the folder cannot be written to.
    """
    path = Path(path)
    dataset = Dataset(tuple(trajectories), metadata or {})
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


def read_trajectories(path: str | Path) -> Dataset:
    """Read a file in the layout of `write_trajectories`, whatever program wrote it.

    Nothing in the file is executed and no link to another file is followed. Raises
    `InvalidInputError` naming file, trajectory and field where anything is wrong.
    """
    with _opened(Path(path)) as root:
        trajectories = tuple(_read_trajectory(each) for each in _groups(root))
        metadata = _read_metadata(root)
        with _naming(root.where):
            return Dataset(trajectories, metadata)


@dataclass(frozen=True)
class FileSummary:
    """The contents of a dataset file of ``R`` trajectories."""

    format_version: int
    trajectory_name: tuple[str, ...]
    """[R]"""
    steps: tuple[int, ...]
    """[R] T"""
    node_name: tuple[tuple[str, ...], ...]
    """[R][N]"""
    dt: tuple[float, ...]
    """[R] s"""
    dimension: tuple[int, ...]
    """[R] D"""
    control_size: tuple[int, ...]
    """[R] U"""
    has_contact: tuple[bool, ...]
    """[R]"""
    metadata: Metadata
    size: int
    """Size of the file, bytes."""


def describe_file(path: str | Path) -> FileSummary:
    """The contents of a file, from shapes, names and attributes alone.

    Raises `InvalidInputError` as `read_trajectories` does; numbers in arrays are not checked.
    """
    path = Path(path)
    with _opened(path) as root:
        groups = _groups(root)
        positions = [each.shape("position", ARRAYS["position"]) for each in groups]
        return FileSummary(
            format_version=VERSION,
            trajectory_name=tuple(root.child(TRAJECTORIES).names_by_number()),
            steps=tuple(shape[0] - 1 for shape in positions),
            node_name=tuple(each.texts("node_name") for each in groups),
            dt=tuple(_read_dt(each) for each in groups),
            dimension=tuple(shape[2] for shape in positions),
            control_size=tuple(each.shape("control", ARRAYS["control"])[1] for each in groups),
            has_contact=tuple("contact" in each.names() for each in groups),
            metadata=_read_metadata(root),
            size=path.stat().st_size,
        )


@contextmanager
def _opened(path: Path) -> Iterator[UntrustedGroup]:
    """The root of a file of this format and version."""
    if not path.exists():
        raise InvalidInputError(f"{path}: does not exist")
    if not path.is_file():
        raise InvalidInputError(f"{path}: must be a file, found a folder or device")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"{path}: may not be read by this user")
    with reading(str(path)):
        if not h5py.is_hdf5(path):
            raise InvalidInputError(
                f"{path}: must be a dataset in HDF5 (docs/file-format.md), found something else "
                "or a damaged file"
            )
        with h5py.File(path, "r", locking="best-effort") as file:
            root = UntrustedGroup(str(path), file)
            if "format" not in file.attrs or root.attribute("format") != FORMAT:
                raise InvalidInputError(
                    f"{path}: attribute 'format' must be {FORMAT!r}, as docs/file-format.md says; "
                    "this HDF5 file holds something else"
                )
            version = root.attribute("format_version")
            if version != VERSION or isinstance(version, (str, bool)):
                raise InvalidInputError(
                    f"{path}: attribute 'format_version' must be {VERSION}, found {version!r}"
                )
            yield root


def _groups(root: UntrustedGroup) -> list[UntrustedGroup]:
    parent = root.child(TRAJECTORIES)
    return [parent.child(name) for name in parent.names_by_number()]


def _read_trajectory(group: UntrustedGroup) -> Trajectory:
    """The trajectory in ``group``; raises `InvalidInputError` naming it and the field."""
    there = group.names()
    arrays: dict[str, Any] = {
        _ATTRIBUTES.get(name, name): _read_array(group, name)
        for name in ARRAYS
        if name not in OPTIONAL or name in there
    }
    names: dict[str, Any] = {name: group.texts(name) for name in NAMES}
    dt, metadata = _read_dt(group), _read_metadata(group)
    of_scene = {name: arrays.pop(name) for name in list(arrays) if name in _OF_SCENE}
    with _naming(group.where):
        dimension = arrays["position"].shape[2]
        scene = Scene(**names, **of_scene, dt=dt, dimension=dimension, metadata=metadata)
        return Trajectory(scene, **arrays)


def _read_dt(group: UntrustedGroup) -> float:
    """Time between two steps, s."""
    dt = group.attribute("dt")
    if isinstance(dt, (str, bool)):
        raise InvalidInputError(f"{group.where}: dt must be a number of seconds, found {dt!r}")
    return float(dt)


def _read_metadata(group: UntrustedGroup) -> Metadata:
    """Free-form metadata; none where the group for it is absent."""
    return group.child(METADATA).attributes() if METADATA in group.names() else {}


def _read_array(group: UntrustedGroup, name: str) -> np.ndarray:
    field = ARRAYS[name]
    value = group.array(name, field)
    if "b" not in field.kinds:
        return value
    if not np.isin(value, (0, 1)).all():
        raise InvalidInputError(f"{group.where}/{name}: must hold only 0 and 1")
    return value.astype(bool)


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """Name the origin of values that `Scene`, `Trajectory` or `Dataset` refuse."""
    try:
        yield
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def _write_trajectory(
    where: str, group: h5py.Group, trajectory: Trajectory, compress: bool
) -> None:
    """Fill ``group``; ``where`` names it in errors."""
    group.attrs["dt"] = float(trajectory.scene.dt)
    _write_metadata(where, group, trajectory.scene.metadata)
    for name in NAMES:
        texts = _fixed_texts(f"{where}/{name}", getattr(trajectory.scene, name))
        _write_array(group, name, texts, compress)
    for name, field in ARRAYS.items():
        owner = trajectory.scene if name in _OF_SCENE else trajectory
        value = getattr(owner, _ATTRIBUTES.get(name, name))
        if value is None:
            continue
        written = _write_array(group, name, value, compress)
        if field.unit is not None:
            written.attrs["unit"] = _fixed_text(where, field.unit)


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
        if not isinstance(text, str) or "\0" in text or not _is_unicode(text):
            raise InvalidInputError(f"{where}: must be Unicode without NUL, found {text!r}")
    encoded = [text.encode("utf-8") for text in texts]
    length = max([1, *(len(text) for text in encoded)])
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", length))


def _fixed_text(where: str, text: str) -> np.ndarray:
    return _fixed_texts(where, (text,)).reshape(())


def _is_unicode(text: str) -> bool:
    """Lone surrogates are no characters, and have no UTF-8."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)
