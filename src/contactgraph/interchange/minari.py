"""Minari datasets: HDF5 of the folder ``data`` with JSON beside it.

The layout is that of Minari 0.4 and 0.5 (https://minari.farama.org): a group ``episode_N`` for each
episode, with observations of T + 1 states, possibly in groups, and T actions.
"""

import json
import re
from collections.abc import Callable, Iterable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.untrusted_hdf5 import UntrustedGroup, opened
from contactgraph.interchange.export_layout import MAP_FILE, ExportLayout, new_folder
from contactgraph.interchange.recording import (
    Column,
    Episode,
    Recording,
    check_count,
    check_file,
    read_json,
)

_FILE, _METADATA = "main_data.hdf5", "metadata.json"
_LARGEST_FILE = 2**34
_PARTS = ("observations", "actions", "infos", "rewards", "terminations", "truncations")
_DEEPEST = 8
_WIDEST = 4096
"""Numbers of a row, beyond which they are an image."""
_PREFIX = "episode_"
_VERSION = "0.5.0"
"""Minari's own, of the layout that is written."""


def read_minari(source: Path) -> Recording:
    """The dataset in the folder ``source``, in its folder ``data`` or in that one's file."""
    path = source
    if source.is_dir():
        path = source / "data" / _FILE if (source / "data").is_dir() else source / _FILE
    about = path.with_name(_METADATA)
    metadata = read_json(about).content if about.exists() else {}
    kind = metadata.get("data_format", "hdf5")
    if kind != "hdf5":
        raise InvalidInputError(
            f"{about}: data_format must be hdf5, found {kind!r}; Minari itself reads it, and "
            'records hdf5 with data_format="hdf5"'
        )
    if not path.exists():
        raise InvalidInputError(
            f"{source}: must be a folder of Minari with data/{_FILE} (often below "
            "~/.minari/datasets), or that file"
        )
    check_file(path, _LARGEST_FILE)
    with opened(path) as root:
        episodes = read_episodes(root, _PREFIX, _episode)
    total = metadata.get("total_episodes")
    if total not in (None, len(episodes)):
        raise InvalidInputError(
            f"{source}: must have {total!r} episodes, as {_METADATA} says, found {len(episodes)}"
        )
    name = json_member(metadata.get("env_spec"), "id")
    return Recording(str(source), episodes, environment=name if isinstance(name, str) else "")


def json_member(text: Any, *keys: str) -> Any:
    """What a JSON text has below these keys; None where it has nothing, or is none."""
    try:
        return reduce(getitem, keys, json.loads(text))
    except (ValueError, TypeError, LookupError, RecursionError):
        return None


def read_episodes(
    group: UntrustedGroup, prefix: str, read: Callable[[str, UntrustedGroup], Episode]
) -> tuple[Episode, ...]:
    """The members ``PREFIX0``, ``PREFIX1`` and so on, by their numbers."""
    names = [each for each in group.names() if each.startswith(prefix)]
    if not all(each.removeprefix(prefix).isdigit() for each in names):
        raise InvalidInputError(f"{group.where}: must hold groups {prefix}0, {prefix}1, …")
    count, episodes = 0, []
    for name in sorted(names, key=lambda each: int(each.removeprefix(prefix))):
        episodes.append(read(name, group.child(name)))
        count += sum(each.values.size for each in episodes[-1].columns.values())
        check_count(group.where, count)
    return tuple(episodes)


def read_columns(
    group: UntrustedGroup, parts: Iterable[str]
) -> tuple[dict[str, Column], dict[str, str]]:
    """The arrays of numbers in these members of a group and below; what the others hold."""
    columns: dict[str, Column] = {}
    others: dict[str, str] = {}

    def add(at: str, inside: UntrustedGroup, member: str) -> None:
        if inside.is_group(member):
            child = inside.child(member)
            for each in child.names() if at.count("/") < _DEEPEST else ():
                add(f"{at}/{each}", child, each)
            return
        found = inside.numbers(member)
        if isinstance(found, str):
            others[at] = found
        elif found[:1].size > _WIDEST:
            others[at] = f"{found.shape[1:]} numbers at each step"
        elif len(found):
            width = int(np.prod(found.shape[1:]))
            columns[at] = Column(found.reshape(len(found), width).astype(np.float64))

    for part in parts:
        if part in group.names():
            add(part, group, part)
    return columns, others


def _episode(name: str, group: UntrustedGroup) -> Episode:
    columns, others = read_columns(group, _PARTS)
    states = {len(each.values) for at, each in columns.items() if at.startswith("observations")}
    for at, each in columns.items():
        if at.startswith("infos/") and {len(each.values) + 1} == states:
            # `reset` gave none: the rows are of the states from the second on.
            columns[at] = Column(np.pad(each.values, ((1, 0), (0, 0)), constant_values=np.nan))
    return Episode(name, columns, others)


def write_minari(layout: ExportLayout, folder: Path) -> None:
    """Writes a dataset, whose observation is one array of all states, to a new folder."""
    name = re.sub(r"[^\w-]+", "-", folder.name).strip("-") or "export"
    metadata = {
        "total_episodes": len(layout.dataset),
        "total_steps": sum(each.steps for each in layout.dataset),
        "data_format": "hdf5",
        "observation_space": _box(len(layout.names)),
        "action_space": _box(layout.dataset.control_size),
        "dataset_id": name if re.search(r"-v\d+$", name) else f"contactgraph/{name}-v0",
        "minari_version": _VERSION,
        "observation_names": layout.names,
    }
    text = layout.map_text('"observations[{}:{}]"'.format, '"actions[{}:{}]"'.format)
    with new_folder(folder) as temporary:
        data = temporary / "data"
        data.mkdir()
        with h5py.File(data / _FILE, "x", track_order=True) as file:
            for index, each in enumerate(layout.dataset):
                group = file.create_group(f"{_PREFIX}{index}")
                group.attrs.update(id=index, total_steps=each.steps)
                group["observations"] = layout.states(each)
                group["actions"] = each.control
                group["rewards"] = np.zeros(each.steps)
                group["terminations"] = np.zeros(each.steps, dtype=bool)
                group["truncations"] = np.arange(each.steps) == each.steps - 1
        (data / _METADATA).write_text(json.dumps(metadata), encoding="utf-8")
        (temporary / MAP_FILE).write_text(text, encoding="utf-8")


def _box(size: int) -> str:
    """A space of ``size`` numbers in Minari's JSON."""
    bounds = {"low": [-np.inf] * size, "high": [np.inf] * size}
    return json.dumps({"type": "Box", "dtype": "float64", "shape": [size], **bounds})
