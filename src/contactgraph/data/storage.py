"""Dataset files: HDF5 in the layout of docs/file-format.md."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

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
    RUNS,
    VERSION,
    UntrustedGroup,
    reading,
)


def write_trajectories(
    path: str | Path,
    trajectories: Sequence[Trajectory],
    metadata: Metadata | None = None,
    compress: bool = False,
) -> None:
    """Write runs to ``path``; whoever looks sees the old file or the whole new one, never half.

    Raises `InvalidInputError` where runs disagree (see `Dataset`), a name or a metadata value
    cannot be stored, or the folder cannot be written to.
    """
    path = Path(path)
    dataset = Dataset(tuple(trajectories), metadata or {})
    with (
        atomic_write(path) as temporary,
        # From v110 on all structure carries checksums, so damage is found and not followed.
        h5py.File(temporary, "x", libver=("v110", "v110")) as file,
    ):
        file.attrs["format"] = fixed_text(str(path), FORMAT)
        file.attrs["format_version"] = VERSION
        write_metadata(str(path), file, dataset.metadata)
        runs = file.create_group(RUNS)
        for number, run in enumerate(dataset):
            name = f"{number:06d}"
            write_trajectory(f"{path}: {RUNS}/{name}", runs.create_group(name), run, compress)


def read_trajectories(path: str | Path) -> Dataset:
    """Read a file that `write_trajectories`, or anyone who keeps to the layout, has written.

    Nothing in the file is executed and nothing outside it is followed. Raises
    `InvalidInputError` naming file, trajectory and field for whatever is wrong with it.
    """
    with _opened(Path(path)) as root:
        runs = tuple(read_trajectory(run) for run in _runs(root))
        metadata = read_metadata(root)
        with naming(root.where):
            return Dataset(runs, metadata)


@dataclass(frozen=True)
class FileSummary:
    """What is in a dataset file of ``R`` runs."""

    format_version: int
    run_name: tuple[str, ...]
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
    """What is in a file, from shapes, names and attributes alone.

    Raises `InvalidInputError` as `read_trajectories` does; numbers inside arrays are not looked at.
    """
    path = Path(path)
    with _opened(path) as root:
        runs = _runs(root)
        positions = [run.shape("position", ARRAYS["position"]) for run in runs]
        return FileSummary(
            format_version=VERSION,
            run_name=tuple(root.child(RUNS).names_by_number()),
            steps=tuple(shape[0] - 1 for shape in positions),
            node_name=tuple(run.texts("node_name") for run in runs),
            dt=tuple(read_dt(run) for run in runs),
            dimension=tuple(shape[2] for shape in positions),
            control_size=tuple(run.shape("control", ARRAYS["control"])[1] for run in runs),
            has_contact=tuple("contact" in run.names() for run in runs),
            metadata=read_metadata(root),
            size=path.stat().st_size,
        )


@contextmanager
def _opened(path: Path) -> Iterator[UntrustedGroup]:
    """The root of a file of our format and of a version that we know."""
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


def _runs(root: UntrustedGroup) -> list[UntrustedGroup]:
    runs = root.child(RUNS)
    return [runs.child(name) for name in runs.names_by_number()]


def read_trajectory(group: UntrustedGroup) -> Trajectory:
    """The run in ``group``; raises `InvalidInputError` naming it and the field."""
    position = _array(group, "position")
    velocity, control = _array(group, "velocity"), _array(group, "control")
    contact, skeleton = _optional_array(group, "contact"), _optional_array(group, "skeleton")
    tracked, measured_at = _optional_array(group, "tracked"), _optional_array(group, "measured_at")
    names, types = group.texts("node_name"), group.texts("node_type")
    actuated, dt, metadata = _array(group, "actuated"), read_dt(group), read_metadata(group)
    anchor, goal = _optional_array(group, "anchor"), _optional_array(group, "goal")
    gravity = _optional_array(group, "gravity")
    mass, radius = _optional_array(group, "mass"), _optional_array(group, "radius")
    size, edges = _optional_array(group, "size"), _optional_array(group, "candidate_edges")
    with naming(group.where):
        scene = Scene(
            node_name=names,
            node_type=types,
            actuated=actuated,
            dt=dt,
            dimension=position.shape[2],
            anchor=anchor,
            goal=goal,
            gravity=gravity,
            mass=mass,
            radius=radius,
            size=size,
            candidate_edges=edges,
            metadata=metadata,
        )
        return Trajectory(
            scene, position, velocity, control, contact, skeleton, tracked, measured_at
        )


def read_dt(group: UntrustedGroup) -> float:
    """Time between two steps, s."""
    dt = group.attribute("dt")
    if isinstance(dt, (str, bool)):
        raise InvalidInputError(f"{group.where}: dt must be a number of seconds, found {dt!r}")
    return float(dt)


def read_metadata(group: UntrustedGroup) -> Metadata:
    """Free-form metadata; none where the group for it is absent."""
    return group.child(METADATA).attributes() if METADATA in group.names() else {}


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Say where the values came from that `Scene`, `Trajectory` or `Dataset` refused."""
    try:
        yield
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def _optional_array(group: UntrustedGroup, name: str) -> np.ndarray | None:
    return _array(group, name) if name in group.names() else None


def _array(group: UntrustedGroup, name: str) -> np.ndarray:
    field = ARRAYS[name]
    value = group.array(name, field)
    if "b" not in field.kinds:
        return value
    if not np.isin(value, (0, 1)).all():
        raise InvalidInputError(f"{group.where}/{name}: must hold only 0 and 1")
    return value.astype(bool)


_ONE_CHUNK = 2**24
"""Arrays up to this many bytes are one chunk, whose address the header's checksum covers."""


def write_trajectory(where: str, group: h5py.Group, run: Trajectory, compress: bool) -> None:
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
