"""Small recordings of every format, as other programs write them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.interchange import Recording, to_trajectories
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.scene_map import parse_map

BODY = '[[body]]\nname = "box"\nposition = {}\n'
XY = BODY.format('["x", "y"]')
SPACE = "# in space\n"
FETCH_STEPS, TAKE_ROWS, RATE = 12, 48, 120.0


def minari_folder(folder: Path, episodes: int = 2) -> Path:
    """A dataset as Minari's collector writes it: resizable chunks, a text of variable length."""
    (folder / "data").mkdir(parents=True)
    rng = np.random.default_rng(0)
    spec = json.dumps({"id": "FetchPush-v4"})
    metadata = {"total_episodes": episodes, "data_format": "hdf5", "env_spec": spec}
    (folder / "data" / "metadata.json").write_text(json.dumps(metadata))
    with h5py.File(folder / "data" / "main_data.hdf5", "w", track_order=True) as file:
        for index in range(episodes):
            group = file.create_group(f"episode_{index}")
            group.attrs["id"], group.attrs["seed"] = index, index
            state = rng.normal(size=(FETCH_STEPS + 1, 25))
            state[:, :6] = [1.2, 0.7, 0.5, 1.3, 0.7, 0.45] + 0.01 * state[:, :6]
            for name, values in (
                ("observations/observation", state),
                ("observations/desired_goal", np.tile([1.3, 0.7, 0.42], (FETCH_STEPS + 1, 1))),
                ("actions", rng.uniform(-1, 1, (FETCH_STEPS, 4)).astype(np.float32)),
                ("rewards", np.zeros(FETCH_STEPS)),
            ):
                shape = (None, *values.shape[1:])
                group.create_dataset(name, data=values, chunks=True, maxshape=shape)
            texts = np.array(["push"] * FETCH_STEPS, dtype=object)
            group.create_dataset("infos/text", data=texts, dtype=h5py.string_dtype())
    return folder


def turning_t() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Agent [S, 2], T's corners [S, 16], its pose [S, 3] in pixels and rad, and action [S, 2]."""
    steps = np.arange(20.0)
    pose = np.stack([200 + 3 * steps, 250 - 2 * steps, 0.4 * steps], axis=1)
    corners = np.array(
        [[-60, 0], [60, 0], [60, 30], [-60, 30], [-15, 30], [15, 30], [15, 120], [-15, 120]]
    )
    sine, cosine = np.sin(pose[:, 2]), np.cos(pose[:, 2])
    turn = np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), -1, 0)
    placed = pose[:, None, :2] + corners @ np.swapaxes(turn, 1, 2)
    agent = np.stack([100 + steps, 100 + 5 * np.sin(steps)], axis=1)
    return agent, placed.reshape(len(steps), 16), pose, agent + 4.0


def lerobot_folder(folder: Path, episodes: int = 2) -> Path:
    """A dataset of version 3 with PushT's keypoints, in two files of data."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    agent, corners, _, action = turning_t()
    rows = len(agent)
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": None},
        "observation.environment_state": {"dtype": "float32", "shape": [16], "names": None},
        "observation.image": {"dtype": "video", "shape": [3, 96, 96], "names": None},
        "action": {"dtype": "float32", "shape": [2], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "index": {"dtype": "int64", "shape": [1], "names": None},
        "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    info = {
        "codebase_version": "v3.0",
        "fps": 10,
        "total_episodes": episodes,
        "total_frames": episodes * rows,
        "features": features,
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    for episode in range(episodes):
        lists = {
            name: arrow.FixedSizeListArray.from_arrays(
                arrow.array(values.astype(np.float32).ravel()), values.shape[1]
            )
            for name, values in (
                ("observation.state", agent),
                ("observation.environment_state", corners + episode),
                ("action", action),
            )
        }
        table = arrow.table(
            {
                **lists,
                "next.done": np.arange(rows) == rows - 1,
                "timestamp": (np.arange(rows) / 10).astype(np.float32),
                "index": np.arange(rows) + episode * rows,
                "episode_index": np.full(rows, episode),
            }
        )
        parquet.write_table(table, folder / "data" / "chunk-000" / f"file-{episode:03d}.parquet")
    return folder


def motive_file(path: Path, unit: str = "Millimeters", hidden: slice = slice(20, 26)) -> Path:
    """A take of two rigid bodies and a marker, whose block is hidden in some rows; y is up."""
    properties = {
        "Format Version": "1.23",
        "Take Name": "Take 1",
        "Capture Frame Rate": f"{RATE:.6f}",
        "Export Frame Rate": f"{RATE:.6f}",
        "Rotation Type": "Quaternion",
        "Length Units": unit,
        "Coordinate Space": "Global",
    }
    bodies = ["Hand"] * 8 + ["Block"] * 8
    rotation, position = ["Rotation"] * 4, ["Position"] * 3
    parts = [*rotation, *position, "Mean Marker Error"] * 2
    axes = ["X", "Y", "Z", "W", "X", "Y", "Z", ""] * 2
    lines = [
        ",".join(f"{key},{value}" for key, value in properties.items()),
        "",
        ",".join(["", "Type", *["Rigid Body"] * 16, *["Marker"] * 3]),
        ",".join(["", "Name", *bodies, *["Block:Marker1"] * 3]),
        ",".join(["", "ID", *["5A"] * 8, *["5B"] * 8, *["5C"] * 3]),
        ",".join(["", "", *parts, *position]),
        ",".join(["Frame", "Time (Seconds)", *axes, "X", "Y", "Z"]),
    ]
    scale = {"Meters": 1.0, "Millimeters": 1000.0}[unit]
    for row in range(TAKE_ROWS):
        time = row / RATE
        half = 0.5 * (0.3 + time)
        turn = [0.0, np.sin(half), 0.0, np.cos(half)]
        hand = [0.0, 0.0, 0.0, 1.0, *(scale * each for each in (time, 0.05, -0.2)), 0.0001]
        block = [*turn, *(scale * each for each in (0.3 + time**2, 0.02, 0.1 * time)), 0.0002]
        marker = [f"{scale * each:.6f}" for each in (0.3, 0.05, 0.0)]
        shown = [f"{each:.6f}" for each in (*hand, *block)] + marker
        if range(TAKE_ROWS)[hidden].count(row):
            shown[8:16] = [""] * 8
        lines.append(",".join([str(row), f"{time:.6f}", *shown]))
    path.write_text("\n".join(lines) + "\n")
    return path


def mcap_file(path: Path) -> Path:
    """Poses of two bodies with uneven stamps, and a force in between, as rosbag2 stores them."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    types = store.types
    rng = np.random.default_rng(0)

    def header(time: float) -> object:
        stamp = types["builtin_interfaces/msg/Time"](1700000000 + int(time), int(time % 1 * 1e9))
        return types["std_msgs/msg/Header"](stamp, "world")

    def point(kind: str, *values: float) -> object:
        return types[f"geometry_msgs/msg/{kind}"](*values)

    messages = []
    for body, rate in (("hand", 50.0), ("block", 30.0)):
        for number in range(int(2 * rate)):
            time = (number + rng.uniform(0, 0.3)) / rate
            place = point("Point", 0.1 * time + 0.5 * (body == "block"), np.sin(time), 0.02)
            half = 0.5 * time * (body == "block")
            turn = point("Quaternion", 0.0, 0.0, np.sin(half), np.cos(half))
            message = types["geometry_msgs/msg/PoseStamped"](
                header(time), point("Pose", place, turn)
            )
            messages.append((time, f"/{body}/pose", message))
    for number in range(40):
        time = number / 20.0
        zero = point("Vector3", 0.0, 0.0, 0.0)
        wrench = point("Wrench", point("Vector3", np.sin(3 * time), 1.0, 0.0), zero)
        messages.append(
            (time, "/force", types["geometry_msgs/msg/WrenchStamped"](header(time), wrench))
        )
    messages.append((0.0, "/note", types["std_msgs/msg/String"]("a text")))
    folder = path.with_suffix(".bag")
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for time, topic, message in sorted(messages, key=lambda each: each[0]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            content = store.serialize_cdr(message, kind)
            writer.write(connections[topic], 1700000000 * 10**9 + int(time * 1e9), content)
    next(folder.glob("*.mcap")).rename(path)
    return path


def lerobot_frames(
    folder: Path,
    episodes: list[np.ndarray],
    fps: int,
    stamps: list[np.ndarray] | None = None,
    numbers: list[int] | None = None,
    firsts: list[int] | None = None,
) -> Path:
    """A dataset of states [S, W]; times, episode numbers and first indices may be others."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    tables, count, width = [], 0, episodes[0].shape[1]
    for number, state in enumerate(episodes):
        rows = len(state)
        time = np.arange(rows) / fps if stamps is None else stamps[number]
        first = count if firsts is None else firsts[number]
        columns = {
            "observation.state": arrow.array(list(state.astype(np.float32))),
            "timestamp": time.astype(np.float32),
            "frame_index": np.arange(rows),
            "episode_index": np.full(rows, number if numbers is None else numbers[number]),
            "index": first + np.arange(rows),
        }
        tables.append(arrow.table(columns))
        count += rows
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    (folder / "data" / "chunk-000").mkdir(parents=True, exist_ok=True)
    parquet.write_table(
        arrow.concat_tables(tables), folder / "data" / "chunk-000" / "file-000.parquet"
    )
    kinds = {
        "timestamp": "float32",
        **dict.fromkeys(("frame_index", "episode_index", "index"), "int64"),
    }
    features = {name: {"dtype": kind, "shape": [1]} for name, kind in kinds.items()}
    features["observation.state"] = {"dtype": "float32", "shape": [width]}
    info = {"codebase_version": "v3.0", "total_episodes": len(episodes), "total_frames": count}
    (folder / "meta" / "info.json").write_text(
        json.dumps({**info, "fps": fps, "features": features})
    )
    return folder


def nexus_file(path: Path) -> Path:
    """A trial of Vicon: a device, a segment that turns by 90 degrees, and two markers, in mm."""
    rows = [f"{n + 1},0,{3 * n},0,100,{1000 + 2 * n},0,50" for n in range(40)]
    segments = [f"{n + 1},0,0,0,{90 * n / 40},{3 * n},0,100" for n in range(40)]
    path.write_text(
        "Devices\n1000\n,,Force\nFrame,Sub Frame,Fz\n,,N\n1,0,1\n\n"
        "Segments\n100\n,,Box:Box,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n"
        ",,deg,deg,deg,mm,mm,mm\n" + "\n".join(segments) + "\n\n"
        "Trajectories\n100\n,,Box:A,,,Box:B,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n"
        ",,mm,mm,mm,mm,mm,mm\n" + "\n".join(rows) + "\n"
    )
    return path


def robomimic_file(path: Path) -> Path:
    """Two demonstrations, numbers 10 and 2, whose object moves at 0.3 m/s."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        spec = {"env_name": "Lift", "env_kwargs": {"control_freq": 20}}
        data.attrs["env_args"] = json.dumps(spec)
        for demo in (10, 2):
            group = data.create_group(f"demo_{demo}")
            x = 0.015 * np.arange(13)
            place = np.stack([x, 0 * x, 0 * x + demo], 1)
            group["obs/object"], group["next_obs/object"] = place[:12], place[1:]
            group["actions"] = np.ones((12, 7))
            group["obs/agentview_image"] = np.zeros((12, 84, 84, 3), np.uint8)
    return path


def _no_items(node: int, about: Any) -> Any:
    """An empty list, or array of bytes."""
    of_bytes = int(node) == 1 and about[0] in ("uint8", "octet", "byte")
    return np.zeros(0, np.uint8) if of_bytes else []


class Ros:
    """Messages of ROS 2, and bags of them."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.LATEST)

    def __call__(self, kind: str, *values: object) -> Any:
        package, name = kind.split("/")
        return self.store.types[f"{package}/msg/{name}"](*values)

    def empty(self, kind: str) -> Any:
        """A message whose fields are 0, empty texts and lists, or such messages."""
        values: list[Any] = []
        for _, (node, about) in self.store.fielddefs[kind][1]:
            plain = int(node) == 1  # of `rosbags.interfaces.Nodetype`: BASE, NAME, then lists
            if plain:
                text, truth = about[0] == "string", about[0] == "bool"
                values.append("" if text else False if truth else 0.0 if "float" in about[0] else 0)
            else:
                values.append(self.empty(about) if int(node) == 2 else _no_items(*about[0]))
        return self.store.types[kind](*values)

    def header(self, time: float, frame: str = "world") -> Any:
        stamp = self("builtin_interfaces/Time", int(time // 1), round(time % 1 * 1e9))
        return self("std_msgs/Header", stamp, frame)

    def pose(self, x: float) -> Any:
        point = self("geometry_msgs/Point", float(x), 0.0, 0.0)
        return self(
            "geometry_msgs/Pose", point, self("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        )

    def stamped(self, time: float, x: float, frame: str = "world") -> Any:
        return self("geometry_msgs/PoseStamped", self.header(time, frame), self.pose(x))

    def transform(self, time: float, parent: str, child: str, x: float) -> Any:
        turn = self("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        place = self("geometry_msgs/Vector3", float(x), 0.0, 0.0)
        moved = self("geometry_msgs/Transform", place, turn)
        return self("geometry_msgs/TransformStamped", self.header(time, parent), child, moved)

    def bag(self, folder: Path, messages: list[tuple[float, str, Any]]) -> Path:
        """Of messages with their time of recording and topic."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}
            for time, topic, message in messages:
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.store)
                content = self.store.serialize_cdr(message, kind)
                writer.write(topics[topic], round(time * 1e9), content)
        return folder


def imported(
    recording: Recording, text: str, dt: float | None = 0.05, time: str = ""
) -> list[Trajectory]:
    step = "[time]\n" + ("" if dt is None else f"dt = {dt!r}\n") + time if dt or time else ""
    dimension = 3 if text.startswith(SPACE) else 2
    text = f"dimension = {dimension}\n{step}\n{text.removeprefix(SPACE)}"
    found, _ = to_trajectories(recording, parse_map("map", text))
    return list(found)


def refused(recording: Recording, text: str, dt: float | None = 0.05, time: str = "") -> str:
    with pytest.raises(InvalidInputError) as caught:
        imported(recording, text, dt, time)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def table(folder: Path, header: str, rows: Sequence[Sequence[Any]], above: str = "") -> Recording:
    path = folder / "a.csv"
    path.write_text(above + header + "\n" + "".join(",".join(map(str, r)) + "\n" for r in rows))
    return read_csv(path)


def speeds(trajectory: Trajectory, node: int = 0) -> np.ndarray:
    return np.linalg.norm(trajectory.velocity[:, node], axis=1)
