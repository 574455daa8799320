"""ROS 2 recordings: MCAP files, and folders of rosbag2 that hold them.

Only types that ship with the library `rosbags` are read. Definitions in a file are not used,
because `rosbags` makes them into Python code.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

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
_LONGEST = 64
"""Items of a list of messages, beyond which they are no bodies."""
_METADATA = "metadata.yaml"
_MAGIC = b"\x89MCAP0\r\n"
_EPOCH = 10**17
"""ns: stamps above are of a clock that tells the date."""
_SET_BACK = 3
"""Messages in a row that are older than the newest, from which on a clock was set back."""

Header = tuple[str, int | None]
"""The frame and the time, ns, of a message's header."""
_NO_HEADER: Header = "", None


class Part(NamedTuple):
    """Numbers in a message: a row of a column."""

    name: str
    values: np.ndarray
    frame: str = ""
    """Of the coordinates; empty: unknown."""
    stamp: int | None = None
    """ns, of the innermost header. None: there is none."""
    labels: tuple[str, ...] = ()
    """Names of the numbers, if they have some."""
    axes: str = ""
    """``xyzw`` of a quaternion."""
    child: str = ""
    """The frame that a message, not one of a list, tells the pose of."""
    order: int = 0
    """Of the message in the recording."""
    recorded: int = 0
    """ns, on the recorder's clock."""
    instead: str = ""
    """What there is, where it is not read as numbers."""


def read_rosbag(source: Path) -> Recording:
    """The recording in an MCAP file, or in a folder.

    A folder with ``metadata.yaml`` is one episode; in another folder each file is one. The fields
    of messages are columns ``TOPIC.field``, and points and quaternions one each. Transforms are
    named by their child's frame, items of other lists by their index, and numbers that belong to
    names, such as those of joints, by these. A column in several frames, or of several child
    frames, is one for each, ``COLUMN@FRAME``. The time of a row is that of the message's header,
    else that of its recording. Where times are set back, an episode ends.
    """
    paths = files_of(source, (".mcap",))
    together = source.is_dir() and (source / _METADATA).exists()
    episodes: list[Episode] = []
    for group in [paths] if together else [[each] for each in paths]:
        rows: dict[str, list[Part]] = defaultdict(list)
        others: dict[str, str] = {}
        count, orders = 0, itertools.count()
        for path in group:
            check_file(path, _LARGEST_FILE)
            _check_profile(path)
            with reading(str(path)):
                for part in _parts(path, others, orders):
                    count += part.values.size + 1
                    check_count(str(source), count)
                    rows[part.name].append(part)
        name = (source if together else group[0]).name
        episodes += _episodes(name, _by_frame(_by_label(rows, others), others), others)
    return Recording(str(source), tuple(episodes))


def _check_profile(path: Path) -> None:
    """Refuses a sound MCAP file that is not of ROS 2."""
    with path.open("rb") as file:
        head = file.read(len(_MAGIC) + 13)
        size = int.from_bytes(head[-4:], "little")
        profile = file.read(min(size, 64)).decode("utf-8", "replace")
    if not head.startswith(_MAGIC):
        raise InvalidInputError(
            f"{path}: must be MCAP, but begins with {head[:16]!r}; rosbags-convert and "
            "`ros2 bag convert` write it"
        )
    if profile != "ros2":
        kind = f"the profile {profile!r}" if profile else "no profile, as of JSON or Protobuf"
        raise InvalidInputError(
            f"{path}: must be a recording of ROS 2, but has {kind}; write numbers as CSV instead"
        )


def _by_label(rows: dict[str, list[Part]], others: dict[str, str]) -> dict[str, list[Part]]:
    """Numbers with names: a column for each, and all of them in the order of the first message."""
    found: dict[str, list[Part]] = defaultdict(list)
    for name, each in rows.items():
        labels = each[0].labels
        for part in each:
            by_label = dict(zip(part.labels, part.values, strict=False))
            for label, number in by_label.items():
                found[f"{name}.{label}"].append(part._replace(values=np.array([number])))
            if sorted(part.labels) != sorted(labels):
                others[name] = "numbers of several sets of names"
            elif labels:
                part = part._replace(values=np.array([by_label[label] for label in labels]))
            found[name].append(part)
        if name in others:
            found.pop(name)
    return found


def _by_frame(rows: dict[str, list[Part]], others: dict[str, str]) -> dict[str, list[Part]]:
    """A column for each frame, and child frame, where there are several."""
    found: dict[str, list[Part]] = {}
    for name, each in rows.items():
        parts: dict[str, list[Part]] = defaultdict(list)
        children = len({row.child for row in each}) > 1
        frames = len({row.frame for row in each}) > 1
        for row in each:
            of = [row.frame] * frames + [row.child] * children
            parts["@".join([name, *of])].append(row)
        found |= parts
        if len(parts) > 1:
            others[name] = f"numbers in several frames: {', '.join(parts)}"
    return found


def _episodes(name: str, rows: dict[str, list[Part]], others: dict[str, str]) -> list[Episode]:
    """The parts of a recording in which no clock is set back."""
    for column, each in rows.items():
        unset = sum(row.stamp == 0 for row in each)
        if unset and max(row.stamp or 0 for row in each) > _EPOCH:
            rows[column] = [row for row in each if row.stamp != 0]
            others[f"{column}, {unset} messages without a stamp"] = "numbers"
    stamps = {column: _stamps(each) for column, each in rows.items()}
    cuts = sorted({rows[each][at].order for each in rows for at in _set_back(stamps[each])})
    begin = min((int(each.min()) for each in stamps.values()), default=0)
    episodes = []
    for index in range(len(cuts) + 1):
        columns = {}
        for column, each in rows.items():
            mine = np.searchsorted(cuts, [row.order for row in each], side="right") == index
            values = [row.values for row, own in zip(each, mine, strict=True) if own]
            if len({one.size for one in values}) > 1:
                others[column] = "numbers whose count changes"
            elif values:
                times, first = np.unique(stamps[column][mine] - begin, return_index=True)
                kept, like = np.stack(values)[first], each[0]
                columns[column] = Column(kept, 1e-9 * times, like.frame, like.axes)
                if shared := len(values) - len(first):
                    others[f"{column}, {shared} messages with another's stamp"] = "numbers"
        of = f", part {index + 1} of {len(cuts) + 1}, between which a clock was set back"
        episodes.append(Episode(name + (of if cuts else ""), columns, others))
    return episodes


def _stamps(rows: list[Part]) -> np.ndarray:
    """[S] ns: of headers, unless they are not set."""
    stamps = [row.stamp for row in rows]
    unset = None in stamps or not any(stamps)
    return np.array([row.recorded for row in rows] if unset else stamps)


def _set_back(stamps: np.ndarray) -> list[int]:
    """The first message after each time that a clock was set back; single ones are only late."""
    if len(stamps) <= _SET_BACK or np.all(np.diff(stamps) >= 0):
        return []
    period = float(np.median(np.abs(np.diff(stamps))))
    found, newest, late = [], stamps[0], 0
    for index, stamp in enumerate(stamps):
        late = late + 1 if stamp < newest - 0.5 * period else 0
        newest = max(newest, stamp)
        if late == _SET_BACK:
            found.append(index - late + 1)
            newest, late = stamp, 0
    return found


def _parts(path: Path, others: dict[str, str], orders: Iterator[int]) -> Iterator[Part]:
    """The parts of every message, in the order of recording."""
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
                unknown = f"messages of the unknown type {each.msgtype}"
                others[each.topic] = "no numbers" if each.msgtype in store.fielddefs else unknown
            # `Reader.messages` would sort by time, which hides that a clock was set back.
            storage: Any = reader.storage
            for connection, recorded, content in storage.messages_scan(known):
                message = store.deserialize_cdr(content, connection.msgtype)
                about = {"child": _child(message), "order": next(orders), "recorded": recorded}
                for part in _flattened(connection.topic, message, _NO_HEADER, 0):
                    if part.instead:
                        others[part.name] = part.instead
                        continue
                    others.pop(connection.topic, None)
                    yield part._replace(**about)
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


def _child(message: Any) -> str:
    """The frame whose pose a message tells; empty: none."""
    return str(getattr(message, "child_frame_id", "")).strip("/")


def _item(name: str, item: Any, index: int) -> str:
    """The name of an item of a list: by its child frame, or its number, else its place."""
    own = _child(item)
    if not own and getattr(item, "id", None) is not None:
        own = f"{getattr(item, 'ns', '')}{item.id}"
    return f"{name}.{own}" if own else f"{name}[{index}]"


def _flattened(name: str, value: Any, header: Header, depth: int) -> Iterator[Part]:
    """The parts of a message; one that has numbers only, such as a point, is one."""
    fields = getattr(value, "__dataclass_fields__", None)
    if depth > _DEEPEST:
        return
    if fields is None:
        if isinstance(value, bool | int | float):
            yield Part(name, np.array([float(value)]), *header)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            instead = f"{value.size} numbers" if value.size > _WIDEST else ""
            yield Part(name, value.astype(np.float64).ravel(), *header, instead=instead)
        elif isinstance(value, list):
            for index, each in enumerate(value):
                at = _item(name, each, index)
                if at.endswith("]") and index >= _LONGEST:
                    instead = f"items beyond the first {_LONGEST} of {len(value)}"
                    yield Part(f"{name}[{_LONGEST}:]", np.zeros(0), instead=instead)
                    break
                yield from _flattened(at, each, header, depth + 1)
        return
    own: Any = getattr(value, "header", None)
    if hasattr(own, "stamp"):
        header = own.frame_id.strip("/"), own.stamp.sec * 10**9 + own.stamp.nanosec
    parts = {each: getattr(value, each) for each in fields if not each.startswith("__")}
    if depth and all(isinstance(each, int | float) for each in parts.values()):
        axes = "xyzw" if list(parts) == list("xyzw") else ""
        yield Part(name, np.array([float(each) for each in parts.values()]), *header, axes=axes)
        return
    labels = parts.get("name")
    named = tuple(labels) if isinstance(labels, list) else ()
    if len(set(named)) < len(named) or not all(isinstance(each, str) for each in named):
        named = ()  # of two with the same name, nothing tells which is which
    for each, inner in parts.items():
        if named and isinstance(inner, np.ndarray) and len(inner) == len(named):
            yield Part(f"{name}.{each}", inner.astype(np.float64), *header, named)
        elif each != "header":
            yield from _flattened(f"{name}.{each}", inner, header, depth + 1)
