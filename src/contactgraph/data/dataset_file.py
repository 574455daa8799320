"""Dataset files: HDF5 in the layout of docs/file-format.md."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from contactgraph.data.dataset import Dataset, Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.files import atomic_write, check_readable
from contactgraph.data.schema import Field, fields_of, given_fields
from contactgraph.data.trajectory import Scene, Trajectory
from contactgraph.data.untrusted_hdf5 import UntrustedGroup, opened

FORMAT = "contactgraph-dataset"
VERSION = 2
"""The version that is written and read."""
_TRAJECTORIES = "trajectories"
_METADATA = "metadata"
ARRAYS = {
    **fields_of(Scene),
    **fields_of(Trajectory),
    "polygons": Field("W D", unit="m"),
    "polygon_size": Field("Q", int),
}
"""The arrays of a trajectory's group. Polygons are stored as all corners, one after the other."""
REQUIRED = {
    each.name for owner in (Scene, Trajectory) for each in fields(owner) if each.default is MISSING
} & set(ARRAYS)
"""Those that every group has."""
_ONE_CHUNK = 2**24
"""Arrays up to this many bytes are one chunk, whose address the header's checksum covers."""


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
        groups = file.create_group(_TRAJECTORIES)
        for index, each in enumerate(dataset):
            name = f"{index:06d}"
            where = f"{path}: {_TRAJECTORIES}/{name}"
            _write_trajectory(where, groups.create_group(name), each, compress)


def _write_trajectory(
    where: str, group: h5py.Group, trajectory: Trajectory, compress: bool
) -> None:
    """Fill ``group``; ``where`` names it in errors."""
    scene = trajectory.scene
    group.attrs["dt"] = float(scene.dt)
    _write_metadata(where, group, scene.metadata)
    arrays: dict[str, Any] = {
        name: getattr(owner, name) for owner in (scene, trajectory) for name in given_fields(owner)
    }
    if scene.polygons:
        arrays["polygons"] = np.concatenate(scene.polygons)
        arrays["polygon_size"] = np.array([len(each) for each in scene.polygons], dtype=np.int64)
    for name, value in arrays.items():
        field = ARRAYS[name]
        if field.kind is str:
            value = _fixed_texts(f"{where}/{name}", value)
        written = _write_array(group, name, value, compress)
        of_forces = name != "control" or not set(scene.control_kind or ()) - {"force"}
        if field.unit is not None and of_forces:
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
    attributes = group.create_group(_METADATA).attrs
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


def read_trajectories(path: str | Path) -> Dataset:
    """Read a file in the layout of `write_trajectories`, whatever program wrote it.

    Nothing in the file is executed and no link to another file is followed. Raises
    `InvalidInputError` naming file, trajectory and field where anything is wrong.
    """
    path = Path(path)
    check_readable(path)
    expected = "a dataset in HDF5 (docs/file-format.md), found something else or a damaged file"
    with opened(path, expected) as root:
        if "format" not in root.group.attrs or root.attribute("format") != FORMAT:
            raise InvalidInputError(
                f"{path}: attribute 'format' must be {FORMAT!r}, as docs/file-format.md says; "
                "this HDF5 file holds something else"
            )
        version = root.attribute("format_version")
        if version != VERSION:
            raise InvalidInputError(
                f"{path}: attribute 'format_version' must be {VERSION}, found {version!r}"
            )
        groups = root.child(_TRAJECTORIES)
        trajectories = tuple(
            _read_trajectory(groups.child(name)) for name in groups.names_by_number()
        )
        metadata = _read_metadata(root)
        with _naming(root.where):
            return Dataset(trajectories, metadata)


def _read_trajectory(group: UntrustedGroup) -> Trajectory:
    """The trajectory in ``group``; raises `InvalidInputError` naming it and the field."""
    there = REQUIRED | set(group.names())
    arrays: dict[str, Any] = {
        name: group.array(name, field) for name, field in ARRAYS.items() if name in there
    }
    dt, metadata = group.attribute("dt"), _read_metadata(group)
    if isinstance(dt, (str, bool)):
        raise InvalidInputError(f"{group.where}: dt must be a number of seconds, found {dt!r}")
    with _naming(group.where):
        if len(arrays.keys() & {"polygons", "polygon_size"}) == 1:
            raise InvalidInputError("polygons and polygon_size must be given together")
        if "polygons" in arrays:
            arrays["polygons"] = _cut(arrays["polygons"], arrays.pop("polygon_size"))
        of_scene = {name: arrays.pop(name) for name in fields_of(Scene) if name in arrays}
        dimension = arrays["position"].shape[2]
        scene = Scene(**of_scene, dt=float(dt), dimension=dimension, metadata=metadata)
        return Trajectory(scene, **arrays)


def _cut(corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, ...]:
    """The polygons of these sizes, whose corners ``[W, 2]`` are stored one after the other."""
    if np.any(sizes < 3) or int(sizes.sum(dtype=object)) != len(corners):
        raise InvalidInputError(
            f"polygon_size must be numbers of corners of at least 3, {len(corners)} in total, "
            f"found {sizes.tolist()}"
        )
    return tuple(np.split(corners, np.cumsum(sizes.astype(np.int64))[:-1])) if len(sizes) else ()


def _read_metadata(group: UntrustedGroup) -> Metadata:
    """Free-form metadata; none where the group for it is absent."""
    return group.child(_METADATA).attributes() if _METADATA in group.names() else {}


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """Name the origin of values that `Scene`, `Trajectory` or `Dataset` refuse."""
    try:
        yield
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error
