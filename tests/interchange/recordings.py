"""Small recordings of every format, as other programs write them."""

import json
from pathlib import Path

import h5py
import numpy as np

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
