"""Damaged and hostile files of every format are read or refused in one line, soon."""

import os
import resource
import struct
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from recordings import lerobot_folder, mcap_file, minari_folder

from contactgraph.data import InvalidInputError
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.rosbag import read_rosbag

HERE = Path(__file__).parent


def fuzz(count: int, seed: int) -> str:
    """A process of its own, because a reader in C could crash or hang."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(HERE)])}
    command = [sys.executable, str(HERE / "fuzz.py"), str(count), str(seed)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=3000, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_two_hundred_damaged_files_of_each_format() -> None:
    lines = fuzz(200, 0).splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "minari",
        "lerobot",
        "csv",
        "motive",
        "robomimic",
        "nexus",
        "rosbag",
    ]
    refused = [int(line.split(", ")[1].split()[0]) for line in lines]
    assert all(50 < each < 200 for each in refused), lines


@pytest.mark.slow
def test_two_thousand_damaged_files_of_each_format() -> None:
    assert len(fuzz(2000, 1).splitlines()) == 7


def test_a_chunk_that_unpacks_to_more_than_it_declares(tmp_path: Path) -> None:
    """`rosbags` unpacks a chunk before it compares sizes: 16 kB here would be 256 MiB."""
    from rosbags.rosbag2 import storage_mcap

    path = mcap_file(tmp_path / "bag.mcap")
    content = path.read_bytes()
    small = storage_mcap.zstd.compress(bytes(2**28))
    assert len(small) < 2**16
    at = content.index(b"zstd") - 4
    chunk = at - 9 - 28
    assert content[chunk] == 6
    (size,) = struct.unpack_from("<Q", content, chunk + 1)
    body = content[chunk + 9 : at] + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", len(small)) + small
    rest = content[chunk + 9 + size :]
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + content[-8:]
    end = rest.index(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")
    path.write_bytes(
        content[:chunk]
        + struct.pack("<BQ", 6, len(body))
        + body
        + rest[:0]
        + rest[end : end + 13]
        + footer
    )
    before = _peak_memory()
    with pytest.raises(InvalidInputError) as caught:
        read_rosbag(path)
    assert "\n" not in str(caught.value)
    assert _peak_memory() - before < 2**27


def _peak_memory() -> int:
    """Bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def test_a_list_that_is_longer_than_its_feature(tmp_path: Path) -> None:
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    folder = lerobot_folder(tmp_path / "pusht")
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(path)
    lists = [np.zeros(2)] * (len(table) - 1) + [np.zeros(2**16)]
    action = arrow.array(lists, arrow.list_(arrow.float64()))
    parquet.write_table(table.set_column(2, "action", action), path)
    with pytest.raises(InvalidInputError, match="column 'action' must have 2 numbers in each"):
        read_lerobot(folder)


def test_a_link_to_another_file(tmp_path: Path) -> None:
    folder = minari_folder(tmp_path / "fetch")
    path = folder / "data" / "main_data.hdf5"
    with h5py.File(path, "a") as file:
        del file["episode_0/actions"]
        file["episode_0/actions"] = h5py.ExternalLink("/etc/passwd", "/x")
    with pytest.raises(InvalidInputError, match="found a link to elsewhere"):
        read_minari(folder)


def test_wrong_sources(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for read, message in (
        (read_minari, "must be a folder of Minari with data/main_data.hdf5"),
        (read_lerobot, "must be a folder of LeRobot with meta/info.json"),
        (read_rosbag, "no file that ends in .mcap"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            read(empty)
    (empty / "bag.db3").write_bytes(b"SQLite format 3")
    with pytest.raises(InvalidInputError, match="must be MCAP, but begins with b'SQLite"):
        read_rosbag(empty / "bag.db3")
    info = lerobot_folder(tmp_path / "pusht") / "meta" / "info.json"
    info.write_text(info.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(InvalidInputError, match="codebase_version must be v3"):
        read_lerobot(tmp_path / "pusht")
