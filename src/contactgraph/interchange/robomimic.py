"""Demonstrations of robomimic and robosuite: HDF5 with a group ``data/demo_N`` for each.

The layout is that of https://robomimic.github.io/docs/datasets/overview.html: observations, states
and actions of T steps, and the observation after each step in ``next_obs``.
"""

from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.untrusted_hdf5 import UntrustedGroup, opened
from contactgraph.interchange.minari import json_member, read_columns, read_episodes
from contactgraph.interchange.recording import Column, Episode, Recording, check_file

_LARGEST_FILE = 2**36
_PREFIX = "demo_"


def read_robomimic(source: Path) -> Recording:
    """The demonstrations in a file; columns are ``obs/KEY``, ``states`` and ``actions``.

    The time of a step is that of the control frequency in the file's description of the
    environment. Where there is ``next_obs``, its last row follows those of ``obs``.
    """
    check_file(source, _LARGEST_FILE)
    with opened(source) as root:
        if "data" not in root.names() or not root.is_group("data"):
            raise InvalidInputError(f"{source}: must hold a group data, as robomimic's files do")
        data = root.child("data")
        description = data.group.attrs.get("env_args")
        episodes = read_episodes(data, _PREFIX, _episode)
    name = json_member(description, "env_name")
    rate = json_member(description, "env_kwargs", "control_freq")
    dt = 1.0 / rate if type(rate) in (int, float) and 0.0 < rate < 1e6 else None
    return Recording(str(source), episodes, dt, name if isinstance(name, str) else "")


def _episode(name: str, group: UntrustedGroup) -> Episode:
    columns, others = read_columns(group, [each for each in group.names() if each != "next_obs"])
    count = group.group.attrs.get("num_samples")
    if count is not None and "actions" in columns and len(columns["actions"].values) != count:
        raise InvalidInputError(
            f"{group.where}: must have {count} actions, as num_samples says, "
            f"found {len(columns['actions'].values)}"
        )
    after, _ = read_columns(group, ("next_obs",))
    for at, following in after.items():
        at = at.removeprefix("next_")
        if at in columns and columns[at].values.shape == following.values.shape:
            columns[at] = Column(np.concatenate([columns[at].values, following.values[-1:]]))
    return Episode(name, columns, others)
