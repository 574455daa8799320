"""The columns of an exported dataset, and the import map by which they are read back."""

import json
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import Dataset, InvalidInputError, Trajectory

MAP_FILE = "map.toml"
"""Beside the data in the folder of an export."""
_TURNS = {"orientation": "wxyz", "angular_velocity": "xyz"}
_OF_BODY = ("mass", "radius", "size", "anchor", "reach")
_OF_SCENE = ("gravity", "planes", "pins", "pin_points", "candidate_edges")
_NOT_EXPORTED = ("link_positions",)

Reference = Callable[[int, int], str]
"""The TOML value that refers to columns ``start`` to ``stop - 1``."""


@dataclass(frozen=True, eq=False)
class Group:
    """Columns that belong together."""

    key: str
    """In the map: a body's name and the key of its table, or ``goal`` or a pair."""
    names: tuple[str, ...]
    read: Callable[[Trajectory], np.ndarray]
    """[T+1, W] of a trajectory."""


@dataclass(frozen=True, eq=False)
class ExportLayout:
    """The columns of all states of a dataset, one after the other."""

    dataset: Dataset
    groups: tuple[Group, ...]
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
        first = self.dataset.trajectories[0].scene
        at, start = {}, 0
        for group in self.groups:
            at[group.key] = state(start, start + len(group.names))
            start += len(group.names)
        lines = ["# Made by contactgraph export: contactgraph import reads this folder by it."]
        lines.append(f"dimension = {first.dimension}")
        lines += [
            f"{name} = {_toml(getattr(first, name))}"
            for name in _OF_SCENE
            if getattr(first, name) is not None and f"scene {name}" not in self.left_out
        ]
        if "goal" in at:
            lines.append(f"goal = {at['goal']}")
        lines += ["", "[time]", f"dt = {_toml(first.dt)}"]
        for index, name in enumerate(first.node_name):
            lines += ["", "[[body]]", f"name = {_toml(name)}"]
            lines.append(f"type = {_toml(first.node_type[index])}")
            lines.append(f"actuated = {_toml(bool(first.actuated[index]))}")
            if first.static is not None:
                lines.append(f"static = {_toml(bool(first.static[index]))}")
            prefix = f"{name}."
            lines += [f"{k[len(prefix) :]} = {v}" for k, v in at.items() if k.startswith(prefix)]
            for key in _OF_BODY:
                value = getattr(first, key)
                if value is None or f"scene {key}" in self.left_out:
                    continue
                if np.isfinite(value[index]).all():
                    lines.append(f"{key} = {_toml(value[index])}")
            outlines = [] if first.polygons is None else first.polygons
            mine = [
                each
                for each, of in zip(
                    outlines, [] if first.polygon_of is None else first.polygon_of, strict=True
                )
                if of == index
            ]
            if mine:
                lines.append(f"polygons = {_toml([each.tolist() for each in mine])}")
        lines += self._control_lines(action)
        for kind in ("contact", "holding"):
            for key in at:
                if key.startswith(f"{kind} "):
                    one, other = json.loads(key.removeprefix(f"{kind} "))
                    lines += ["", f"[[{kind}]]", f"bodies = {_toml([one, other])}"]
                    lines.append(f"columns = {at[key]}")
        return "\n".join(lines) + "\n"

    def _control_lines(self, action: Reference) -> list[str]:
        scene, lines = self.dataset.trajectories[0].scene, []
        for index in range(self.dataset.control_size):
            kind = "force" if scene.control_kind is None else scene.control_kind[index]
            acting = _acting(scene.actuated, scene.control_of, index, scene.dimension)
            lines += ["", "[[control]]", f"columns = {action(index, index + 1)}"]
            lines.append(f"kind = {_toml(kind)}")
            if len(acting):
                names = [scene.node_name[node] for node in acting]
                lines.append(f"body = {_toml(names[0] if len(names) == 1 else names)}")
        return lines


def _acting(
    actuated: np.ndarray, control_of: np.ndarray | None, component: int, dimension: int
) -> np.ndarray:
    """Nodes on which a component of the control acts."""
    if control_of is not None:
        return np.flatnonzero(control_of[:, component])
    return np.flatnonzero(actuated) if component < dimension else np.zeros(0, dtype=int)


def export_layout(dataset: Dataset) -> ExportLayout:
    """The columns of a dataset, whose trajectories must have the same bodies.

    Raises `InvalidInputError` where they do not, or where nothing can name a body.
    """
    first = dataset.trajectories[0].scene
    for index, each in enumerate(dataset):
        for name in ("node_name", "node_type", "control_kind"):
            if getattr(each.scene, name) != getattr(first, name):
                raise InvalidInputError(
                    f"trajectory {index}: {name} must be that of trajectory 0, "
                    f"{getattr(first, name)}, found {getattr(each.scene, name)}; other formats "
                    "have the same columns in all episodes"
                )
        for name in ("actuated", "static", "control_of"):
            if not _same(getattr(each.scene, name), getattr(first, name)):
                raise InvalidInputError(f"trajectory {index}: {name} must be that of trajectory 0")
    left_out = [
        f"scene {name}"
        for name in (*_OF_SCENE, *_OF_BODY)
        if not all(_same(getattr(e.scene, name), getattr(first, name)) for e in dataset)
        or _is_partly_known(getattr(first, name), name)
    ]
    left_out += [
        name for name in _NOT_EXPORTED if any(getattr(e, name) is not None for e in dataset)
    ]
    return ExportLayout(dataset, tuple(_groups(dataset, left_out)), tuple(left_out))


def _is_partly_known(value: np.ndarray | None, name: str) -> bool:
    """Whether numbers of one body are known in part only, which a map cannot tell."""
    if value is None or name not in _OF_BODY or value.ndim < 2:
        return False
    known = np.isfinite(value).reshape(len(value), -1)
    return bool(np.any(known.any(axis=1) & ~known.all(axis=1)))


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    one, other = np.asarray(one), np.asarray(other)
    return one.shape == other.shape and bool(
        np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    )


def _groups(dataset: Dataset, left_out: list[str]) -> Iterator[Group]:
    scene, axes = dataset.trajectories[0].scene, "xyz"[: dataset.dimension]
    measured = [name for name in ("tracked", "measured_at") if _in_all(dataset, name, left_out)]
    turning = [name for name in _TURNS if _in_all(dataset, name, left_out)]
    for node, body in enumerate(scene.node_name):
        for key in ("position", "velocity"):
            yield _of_node(body, key, node, axes)
        for key in turning:
            if any(np.isfinite(getattr(each, key)[:, node]).any() for each in dataset):
                parts = ("angle",) if dataset.dimension == 2 else tuple(_TURNS[key])
                yield _of_node(body, key, node, parts)
        for key in measured:
            yield _of_node(body, key, node, ("",))
    if all(each.scene.goal is not None for each in dataset):
        names = tuple(f"goal.{axis}" for axis in axes)
        yield Group("goal", names, lambda t: np.tile(np.asarray(t.scene.goal), (t.steps + 1, 1)))
    elif any(each.scene.goal is not None for each in dataset):
        left_out.append("goal")
    for kind in ("contact", "holding"):
        if _in_all(dataset, kind, left_out):
            for one, other in combinations(range(scene.node_count), 2):
                yield _of_pair(kind, one, other, scene.node_name[one], scene.node_name[other])


def _of_pair(kind: str, one: int, other: int, *bodies: str) -> Group:
    def read(trajectory: Trajectory) -> np.ndarray:
        return np.asarray(getattr(trajectory, kind)[:, one, [other]], dtype=np.float64)

    return Group(f"{kind} {json.dumps(bodies)}", (".".join([kind, *bodies]),), read)


def _of_node(body: str, key: str, node: int, parts: Any) -> Group:
    def read(trajectory: Trajectory) -> np.ndarray:
        found = np.asarray(getattr(trajectory, key)[:, node], dtype=np.float64)
        return found.reshape(len(found), -1)

    names = tuple(f"{body}.{key}.{part}".rstrip(".") for part in parts)
    return Group(f"{body}.{key}", names, read)


def _in_all(dataset: Dataset, name: str, left_out: list[str]) -> bool:
    there = [getattr(each, name) is not None for each in dataset]
    if any(there) and not all(there):
        left_out.append(f"{name} (not in all trajectories)")
    return all(there)


def _toml(value: Any) -> str:
    """Text, numbers, booleans and lists are written as in JSON."""
    return json.dumps(value.tolist() if isinstance(value, np.ndarray) else value, allow_nan=False)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``, which becomes it when the block ends without an error.

    Raises `InvalidInputError` where there is something already, or where it cannot be written.
    """
    if path.exists():
        raise InvalidInputError(f"{path}: must not exist yet")
    if not path.absolute().parent.is_dir():
        raise InvalidInputError(f"{path}: folder {path.parent} does not exist")
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.mkdir()
        yield temporary
        temporary.rename(path)
    except OSError as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"{path}: cannot be written ({reason})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
