"""Reads dataset files: HDF5 in the layout of docs/file-format.md."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data.dataset import Dataset, Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.file_layout import (
    ARRAYS,
    CONTROL_KIND,
    FIELD_OF,
    FORMAT,
    METADATA,
    NAMES,
    OPTIONAL,
    TRAJECTORIES,
    VERSION,
)
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.untrusted_hdf5 import UntrustedGroup, opened

_OF_SCENE = {each.name for each in fields(Scene)}


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
    """`[R][N]`"""
    dt: tuple[float, ...]
    """[R] s"""
    dimension: tuple[int, ...]
    """[R] D"""
    control_size: tuple[int, ...]
    """[R] U"""
    control_kind: tuple[tuple[str, ...] | None, ...]
    """`[R][U]`; None where all components are forces."""
    has_contact: tuple[bool, ...]
    """[R]"""
    has_holding: tuple[bool, ...]
    """[R]"""
    has_orientation: tuple[bool, ...]
    """[R]"""
    static_count: tuple[int, ...]
    """[R] Number of bodies that never move."""
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
        names = [_arrays_in(each) for each in groups]
        positions = [each.shape("position", ARRAYS["position"]) for each in groups]
        return FileSummary(
            format_version=VERSION,
            trajectory_name=tuple(root.child(TRAJECTORIES).names_by_number()),
            steps=tuple(shape[0] - 1 for shape in positions),
            node_name=tuple(each.texts("node_name") for each in groups),
            dt=tuple(_read_dt(each) for each in groups),
            dimension=tuple(shape[2] for shape in positions),
            control_size=tuple(each.shape("control", ARRAYS["control"])[1] for each in groups),
            control_kind=tuple(_read_control_kind(each) for each in groups),
            has_contact=tuple("contact" in each for each in names),
            has_holding=tuple("holding" in each for each in names),
            has_orientation=tuple("orientation" in each for each in names),
            static_count=tuple(
                int(_read_array(group, "static").sum()) if "static" in each else 0
                for group, each in zip(groups, names, strict=True)
            ),
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
        yield root


def _groups(root: UntrustedGroup) -> list[UntrustedGroup]:
    parent = root.child(TRAJECTORIES)
    return [parent.child(name) for name in parent.names_by_number()]


def _read_trajectory(group: UntrustedGroup) -> Trajectory:
    """The trajectory in ``group``; raises `InvalidInputError` naming it and the field."""
    arrays: dict[str, Any] = {
        FIELD_OF.get(name, name): _read_array(group, name) for name in _arrays_in(group)
    }
    names: dict[str, Any] = {name: group.texts(name) for name in NAMES}
    names[CONTROL_KIND] = _read_control_kind(group)
    dt, metadata = _read_dt(group), _read_metadata(group)
    with _naming(group.where):
        if "polygons" in arrays or "polygon_size" in arrays:
            arrays["polygons"] = _cut(arrays.get("polygons"), arrays.pop("polygon_size", None))
        of_scene = {name: arrays.pop(name) for name in list(arrays) if name in _OF_SCENE}
        dimension = arrays["position"].shape[2]
        scene = Scene(**names, **of_scene, dt=dt, dimension=dimension, metadata=metadata)
        return Trajectory(scene, **arrays)


def _arrays_in(group: UntrustedGroup) -> list[str]:
    """The arrays to read: those that must be there, and those that are."""
    there = group.names()
    return [name for name in ARRAYS if name not in OPTIONAL or name in there]


def _read_control_kind(group: UntrustedGroup) -> tuple[str, ...] | None:
    return group.texts(CONTROL_KIND) if CONTROL_KIND in group.names() else None


def _cut(corners: np.ndarray | None, sizes: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """The polygons of these sizes, whose corners ``[W, 2]`` are stored one after the other."""
    if corners is None or sizes is None:
        raise InvalidInputError("polygons and polygon_size must be given together")
    if np.any(sizes < 3) or int(sizes.sum(dtype=object)) != len(corners):
        raise InvalidInputError(
            f"polygon_size must be numbers of corners of at least 3, {len(corners)} in total, "
            f"found {sizes.tolist()}"
        )
    return tuple(np.split(corners, np.cumsum(sizes.astype(np.int64))[:-1])) if len(sizes) else ()


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
