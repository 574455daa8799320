"""Dataset files: HDF5 in the layout of docs/file-format.md."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py

from contactgraph.data.atomic_file import replacing
from contactgraph.data.dataset import Dataset, Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.layout import ARRAYS, FORMAT, RUNS, VERSION
from contactgraph.data.read_run import naming, read_dt, read_metadata, read_run
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.untrusted_hdf5 import UntrustedGroup, reading
from contactgraph.data.write_run import fixed_text, write_metadata, write_run


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
        replacing(path) as temporary,
        # From v110 on all structure carries checksums, so damage is found and not followed.
        h5py.File(temporary, "x", libver=("v110", "v110")) as file,
    ):
        file.attrs["format"] = fixed_text(str(path), FORMAT)
        file.attrs["format_version"] = VERSION
        write_metadata(str(path), file, dataset.metadata)
        runs = file.create_group(RUNS)
        for number, run in enumerate(dataset):
            name = f"{number:06d}"
            write_run(f"{path}: {RUNS}/{name}", runs.create_group(name), run, compress)


def read_trajectories(path: str | Path) -> Dataset:
    """Read a file that `write_trajectories`, or anyone who keeps to the layout, has written.

    Nothing in the file is executed and nothing outside it is followed. Raises
    `InvalidInputError` naming file, trajectory and field for whatever is wrong with it.
    """
    with _opened(Path(path)) as root:
        runs = tuple(read_run(run) for run in _runs(root))
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
