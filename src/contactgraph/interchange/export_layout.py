"""The columns of an exported dataset, and the import map by which they are read back."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from contactgraph.data import Dataset, InvalidInputError, Trajectory
from contactgraph.data.schema import given_fields

MAP_FILE = "map.toml"
"""Beside the data in the folder of an export."""
_OF_BODY = ("actuated", "static", "mass", "radius", "size", "anchor", "reach")
_OF_SCENE = ("gravity", "planes", "pins", "pin_points", "candidate_edges")
_SHARED = ("node_name", "node_type", "control_kind", "actuated", "static", "control_of")
"""What all trajectories of an export have the same."""

Reference = Callable[[int, int], str]
"""The TOML value that refers to columns ``start`` to ``stop - 1``."""


@dataclass(frozen=True)
class Group:
    """Columns that belong together."""

    key: str
    """In the map, and in `Trajectory` or its scene."""
    nodes: tuple[int, ...]
    """The body's or the pair's; none: the scene's."""
    names: tuple[str, ...]

    def read(self, trajectory: Trajectory) -> np.ndarray:
        """[T+1, W]."""
        rows = trajectory.steps + 1
        if not self.nodes:
            return np.tile(getattr(trajectory.scene, self.key), (rows, 1))
        values = getattr(trajectory, self.key)[:, *self.nodes]
        return values.reshape(rows, -1).astype(np.float64)


@dataclass(frozen=True, eq=False)
class ExportLayout:
    """The columns of all states of a dataset, one after the other."""

    dataset: Dataset
    groups: tuple[Group, ...]
    constants: dict[str, np.ndarray]
    """Of all scenes, by the names in `contactgraph.data.Scene`."""
    left_out: tuple[str, ...]
    """What the dataset has that is not exported."""

    @property
    def names(self) -> list[str]:
        """[W] names of the columns."""
        return [name for group in self.groups for name in group.names]

    @property
    def control_names(self) -> list[str]:
        """[U] names of the components of the control."""
        return [f"action.{index}" for index in range(self.dataset.control_size)]

    def states(self, trajectory: Trajectory) -> np.ndarray:
        """[T+1, W]."""
        return np.concatenate([group.read(trajectory) for group in self.groups], axis=1)

    def map_text(self, state: Reference, action: Reference) -> str:
        """The import map, in TOML."""
        scene, start, pairs = self.dataset.trajectories[0].scene, 0, []
        columns: dict[tuple[int, ...], dict[str, str]] = {(): {}}
        for group in self.groups:
            stop = start + len(group.names)
            reference, start = state(start, stop), stop
            if group.names[0].endswith(".w"):
                reference = f'{{ columns = {reference}, order = "wxyz" }}'
            columns.setdefault(group.nodes, {})[group.key] = reference
            if len(group.nodes) == 2:
                bodies = {"bodies": [scene.node_name[node] for node in group.nodes]}
                pairs.append(_table(f"[[{group.key}]]", bodies, {"columns": reference}))
        of_scene = {name: each for name, each in self.constants.items() if name in _OF_SCENE}
        made = "# Made by contactgraph export: contactgraph import reads this folder by it."
        tables = [
            _table(made, {"dimension": scene.dimension, **of_scene}, columns[()]),
            _table("[time]", {"dt": scene.dt}, {}),
        ]
        for node, name in enumerate(scene.node_name):
            body: dict[str, Any] = {"name": name, "type": scene.node_type[node]}
            for key, value in self.constants.items():
                if key in _OF_BODY and np.isfinite(value[node]).all():
                    body[key] = value[node]
            if node in scene.polygon_of:
                outlines = zip(scene.polygons, scene.polygon_of, strict=True)
                body["polygons"] = [each for each, of in outlines if of == node]
            tables.append(_table("[[body]]", body, columns[node,]))
        for index in range(self.dataset.control_size):
            kind = "force" if scene.control_kind is None else scene.control_kind[index]
            acting = scene.actuated & (index < scene.dimension)
            if scene.control_of is not None:
                acting = scene.control_of[:, index]
            control = {"kind": kind, "body": np.array(scene.node_name)[acting]}
            tables.append(_table("[[control]]", control, {"columns": action(index, index + 1)}))
        return "\n".join([*tables, *pairs])


def _table(head: str, values: dict[str, Any], references: dict[str, str]) -> str:
    """A table of TOML, whose texts, numbers, booleans and lists are written as in JSON."""
    # TOML has no surrogate pairs, of which JSON makes the escapes of some letters.
    encoder = json.JSONEncoder(
        ensure_ascii=False, allow_nan=False, default=lambda each: each.tolist()
    )
    texts = {key: encoder.encode(each) for key, each in values.items()} | references
    return "\n".join([head, *(f"{key} = {text}" for key, text in texts.items()), ""])


def export_layout(dataset: Dataset) -> ExportLayout:
    """The columns of a dataset, whose trajectories must have the same bodies.

    Raises `InvalidInputError` where they do not, or where nothing can name a body.
    """
    first = dataset.trajectories[0].scene
    for index, each in enumerate(dataset):
        for name in _SHARED:
            found, wanted = (np.asarray(getattr(s, name)).tolist() for s in (each.scene, first))
            if found != wanted:
                raise InvalidInputError(
                    f"trajectory {index}: {name} must be that of trajectory 0, {wanted}, found "
                    f"{found}; other formats have the same columns in all episodes"
                )
    constants, left_out = {}, []
    for name in (*_OF_SCENE, *_OF_BODY):
        # None becomes NaN.
        values = [np.asarray(getattr(each.scene, name), dtype=np.float64) for each in dataset]
        known = np.isfinite(values[0])
        rest = tuple(range(1, known.ndim))
        # A map cannot tell some numbers of a body without the others.
        partly = np.any(known.any(axis=rest) & ~known.all(axis=rest))
        if partly or not all(np.array_equal(each, values[0], equal_nan=True) for each in values):
            left_out.append(f"scene {name}")
        elif name in given_fields(first):
            constants[name] = getattr(first, name)
    if any(each.link_positions is not None for each in dataset):
        left_out.append("link_positions")

    def recorded(name: str) -> bool:
        """Whether it is in all trajectories."""
        owners = [each.scene if name == "goal" else each for each in dataset]
        there = [name in given_fields(each) for each in owners]
        if any(there) and not all(there):
            left_out.append(f"{name} (not in all trajectories)")
        return all(there)

    axes = "xyz"[: dataset.dimension]
    planar = dataset.dimension == 2
    parts = {
        "position": axes,
        "velocity": axes,
        "orientation": ["angle"] if planar else "wxyz",
        "angular_velocity": ["angle"] if planar else "xyz",
        "tracked": [""],
        "measured_at": [""],
    }
    parts = {key: each for key, each in parts.items() if recorded(key)}
    groups = [
        Group(key, (node,), tuple(f"{body}.{key}.{part}".rstrip(".") for part in each))
        for node, body in enumerate(first.node_name)
        for key, each in parts.items()
        if any(np.isfinite(getattr(trajectory, key)[:, node]).any() for trajectory in dataset)
    ]
    if recorded("goal"):
        groups.append(Group("goal", (), tuple(f"goal.{axis}" for axis in axes)))
    groups += [
        Group(kind, (one, other), (f"{kind}.{first.node_name[one]}.{first.node_name[other]}",))
        for kind in filter(recorded, ("contact", "holding"))
        for one, other in combinations(range(first.node_count), 2)
    ]
    return ExportLayout(dataset, tuple(groups), constants, tuple(left_out))


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``, which becomes it when the block ends without an error.

    Raises `InvalidInputError` where there is something already, or where it cannot be written.
    """
    if path.exists():
        raise InvalidInputError(f"{path}: must not exist yet")
    if not path.absolute().parent.is_dir():
        raise InvalidInputError(f"{path}: folder {path.parent} does not exist")
    try:
        with TemporaryDirectory(prefix=".", dir=path.parent, ignore_cleanup_errors=True) as outer:
            temporary = Path(outer) / "export"
            temporary.mkdir()
            yield temporary
            temporary.rename(path)
    except OSError as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"{path}: cannot be written ({reason})") from error
