"""ROS 2 recordings: MCAP files, and folders of rosbag2 that hold them.

Only types that ship with the library `rosbags` are read. Definitions in a file are not used,
because `rosbags` makes them into Python code.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.untrusted_hdf5 import reading
from contactgraph.interchange.recording import (
    LARGEST,
    Column,
    Episode,
    Recording,
    check_count,
    check_file,
    files_of,
)

_LARGEST_FILE = 2**34
_LARGEST_CHUNK = 2**30
"""Bytes; writers end a chunk at some megabytes."""
_DEEPEST = 6
_WIDEST = 4096
"""Numbers of a message's field, beyond which they are an image or a scan."""
_METADATA = "metadata.yaml"

Rows = dict[str, tuple[list[int], list[np.ndarray]]]
"""By column, its stamps, ns, and its rows."""


def read_rosbag(source: Path) -> Recording:
    """The recording in an MCAP file, or in a folder.

    A folder with ``metadata.yaml`` is one episode; in another folder each file is one. The fields
    of messages are columns ``TOPIC.field``, and points and quaternions one each. The time of a row
    is that of the message's header, else that of its recording.
    """
    paths = files_of(source, (".mcap",))
    together = source.is_dir() and (source / _METADATA).exists()
    episodes = []
    for group in [paths] if together else [[each] for each in paths]:
        rows: Rows = {}
        others: dict[str, str] = {}
        count = 0
        for path in group:
            check_file(path, _LARGEST_FILE)
            with reading(str(path)):
                for name, stamp, values in _fields(path, others):
                    count += values.size + 1
                    check_count(str(source), count)
                    stamps, found = rows.setdefault(name, ([], []))
                    stamps.append(stamp)
                    found.append(values)
        begin = min((min(stamps) for stamps, _ in rows.values()), default=0)
        columns = {}
        for name, (stamps, found) in rows.items():
            if len({each.size for each in found}) > 1:
                others[name] = "numbers whose count changes"
                continue
            times, first = np.unique([stamp - begin for stamp in stamps], return_index=True)
            columns[name] = Column(np.stack(found)[first], 1e-9 * times)
        episodes.append(Episode((source if together else group[0]).name, columns, others))
    return Recording(str(source), tuple(episodes))


def _fields(path: Path, others: dict[str, str]) -> Iterator[tuple[str, int, np.ndarray]]:
    """Column, time [ns] and numbers of every field of every message."""
    try:
        from rosbags.rosbag2 import Reader, storage_mcap
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InvalidInputError(
            f"ROS recordings need rosbags ({error}): pip install 'contactgraph[rosbag]'"
        ) from error
    if path.suffix.lower() != ".mcap":
        raise InvalidInputError(f"{path}: must be a file .mcap or a folder with such files")
    store = get_typestore(Stores.LATEST)
    store.max_sequence_length = LARGEST
    unbounded = storage_mcap.DECOMPRESSORS.copy()
    storage_mcap.DECOMPRESSORS.update(_bounded(storage_mcap.zstd))
    try:
        with Reader(path) as reader:
            known = [each for each in reader.connections if each.msgtype in store.fielddefs]
            for each in reader.connections:
                if each.msgtype not in store.fielddefs:
                    others[each.topic] = f"messages of the unknown type {each.msgtype}"
            for connection, stamp, content in reader.messages(connections=known):
                message = store.deserialize_cdr(content, connection.msgtype)
                time = _stamp(message) or stamp
                for name, values in _flattened(connection.topic, message, 0):
                    if values.size <= _WIDEST:
                        yield name, time, values
                    else:
                        others[name] = f"{values.size} numbers"
    finally:
        storage_mcap.DECOMPRESSORS.update(unbounded)


def _bounded(zstd: Any) -> dict[str, Callable[[bytes, int], bytes]]:
    """Decompressors that stop at the size that a chunk declares; those of `rosbags` do not."""
    from lz4.frame import LZ4FrameDecompressor

    def bounded(decompress: Callable[..., bytes], content: bytes, size: int) -> bytes:
        if size > _LARGEST_CHUNK:
            raise InvalidInputError(f"a chunk must have at most {_LARGEST_CHUNK} bytes")
        return decompress(content, max_length=size)

    return {
        "lz4": lambda content, size: bounded(LZ4FrameDecompressor().decompress, content, size),
        "zstd": lambda content, size: bounded(zstd.ZstdDecompressor().decompress, content, size),
    }


def _stamp(message: Any) -> int:
    """Time of a message's header, ns; 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec


def _flattened(name: str, value: Any, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Names and numbers of a message's fields.

    A part that has numbers only, such as a point, is one. Transforms have their child frame's name.
    """
    fields = getattr(value, "__dataclass_fields__", None)
    if depth > _DEEPEST:
        return
    if fields is None:
        if isinstance(value, bool | int | float):
            yield name, np.array([float(value)])
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            yield name, value.astype(np.float64).ravel()
        elif isinstance(value, list):
            for each in value:
                child = getattr(each, "child_frame_id", "")
                if child:
                    yield from _flattened(f"{name}.{child}", each, depth + 1)
        return
    parts = {each: getattr(value, each) for each in fields if not each.startswith("__")}
    if depth and all(isinstance(each, int | float) for each in parts.values()):
        yield name, np.array([float(each) for each in parts.values()])
        return
    for each, part in parts.items():
        if each != "header":
            yield from _flattened(f"{name}.{each}", part, depth + 1)
