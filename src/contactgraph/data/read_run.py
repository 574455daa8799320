"""One run, or metadata, from a group of an HDF5 file that is not trusted."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from contactgraph.data.dataset import Metadata
from contactgraph.data.errors import InvalidInputError
from contactgraph.data.layout import ARRAYS, METADATA
from contactgraph.data.scene import Scene
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.untrusted_hdf5 import UntrustedGroup


def read_run(group: UntrustedGroup) -> Trajectory:
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
