"""Memory that the simulated robot's processes share: records, ground truth, scene resets."""

import fcntl
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory

_KEPT = 1 << 15
"""Control steps kept: 32 simulated seconds, so that an episode can be read when it is over."""
_MARGIN = 64  # Oldest steps that may be overwritten while they are read
_REQUEST = np.dtype(
    [("asked", "i8"), ("done", "i8"), ("block", "i8"), ("position", "f8", (3,)), ("yaw", "f8")]
)
_TIMEOUT = 5.0  # Wall time to wait for a scene reset, s
_HEADER = np.dtype([("nq", "i8"), ("start", "f8")])
_INDEX = np.dtype("i8")


def create_shared(path: Path, dtype: np.dtype, count: int) -> np.ndarray:
    """[count] zeros in a file that several processes map."""
    return np.asarray(np.memmap(path, dtype, mode="w+", shape=(count,)))


def open_shared(path: Path, dtype: np.dtype, write: bool = False) -> np.ndarray:
    """The array of `create_shared`, without copying."""
    return np.asarray(np.memmap(path, dtype, mode="r+" if write else "r"))


class RingWriter:
    """The writing end of a ring of ``slots`` records in a file, without locks.

    The processors that the arm's library supports keep the order of writes.
    """

    def __init__(self, path: Path, fields: list[tuple], slots: int) -> None:
        self._slots = create_shared(path, _ring_dtype(fields), slots)
        self._slots["number"] = self._slots["again"] = -1
        self._count = create_shared(path.with_suffix(".count"), _INDEX, 1)
        self._number = -1

    def begin(self) -> np.void:
        """The next record, to be filled and then published."""
        self._number += 1
        self._slot = self._slots[self._number % len(self._slots)]
        self._slot["number"] = self._number
        return self._slot

    def publish(self) -> None:
        """Shows the record to readers."""
        self._slot["again"] = self._number
        self._count[0] = self._number + 1


class RingReader:
    """The reading end of `RingWriter`, in any process."""

    def __init__(self, path: Path, fields: list[tuple]) -> None:
        self._slots = open_shared(path, _ring_dtype(fields))
        self._count = open_shared(path.with_suffix(".count"), _INDEX)

    @property
    def count(self) -> int:
        """Number of published records."""
        return int(self._count[0])

    def newest(self) -> np.void:
        """A copy of the newest record; there must be one."""
        while True:
            number = self.count - 1
            record = self._slots[number % len(self._slots)].copy()
            if record["number"] == record["again"] == number:
                return record

    def last(self, first: int) -> np.ndarray:
        """[K]: the complete records from number ``first`` on that are still kept, in order."""
        wanted = np.arange(max(first, self.count - len(self._slots) + _MARGIN, 0), self.count)
        records = self._slots[wanted % len(self._slots)]
        return records[(records["number"] == wanted) & (records["again"] == wanted)]


def _ring_dtype(fields: list[tuple]) -> np.dtype:
    # The two numbers of a record differ while it is written.
    return np.dtype([("number", "i8"), *fields, ("again", "i8")])


def ground_truth_fields(blocks: int, nq: int) -> list[tuple]:
    """The fields of a control step, for ``blocks`` blocks and a ``qpos`` of ``nq`` numbers.

    Nodes are the hand's grasp point and the blocks. Positions are in the frame of the arm's base.
    """
    return [
        ("time", "f8"),  # s, simulated since the start
        ("stamp", "f8"),  # s, on the reader's clock
        ("position", "f8", (1 + blocks, 3)),  # m
        ("velocity", "f8", (1 + blocks, 3)),  # m/s
        ("turn", "f8", (1 + blocks, 4)),  # unit quaternions, the real part first
        ("fingers", "?", (blocks, 2)),  # whether the left, the right finger touches
        ("standing", "?", (blocks,)),  # whether it touches the table
        ("width", "f8"),  # m between the fingers
        ("qpos", "f8", (nq,)),  # of MuJoCo, for a renderer
    ]


def create_ground_truth(folder: Path, blocks: int, nq: int, start: float) -> RingWriter:
    """The ring of control steps of a simulation that starts at ``start`` s, on the reader's clock.

    The number of a record is that of its step, which counts from 0.
    """
    header = create_shared(folder / "header", _HEADER, 1)
    header["nq"], header["start"] = nq, start
    return RingWriter(folder / "truth", ground_truth_fields(blocks, nq), _KEPT)


class GroundTruth:
    """The control steps of a simulation, from any process."""

    def __init__(self, folder: Path, blocks: int) -> None:
        header = open_shared(folder / "header", _HEADER)[0]
        self._start = float(header["start"])
        fields = ground_truth_fields(blocks, int(header["nq"]))
        self._ring = RingReader(folder / "truth", fields)

    def newest(self) -> np.void:
        """The newest step, with the fields of `ground_truth_fields` and its ``number``."""
        return self._ring.newest()

    def since(self, number: int) -> np.ndarray:
        """[K]: the kept steps after ``number``, in order."""
        return self._ring.last(number + 1)

    def between(self, begin: float, end: float) -> np.ndarray:
        """[K]: the kept steps with stamps from ``begin`` to ``end`` s on the reader's clock."""
        rows = self.since(-1)
        return rows[(rows["stamp"] >= begin) & (rows["stamp"] <= end)]

    @property
    def rate(self) -> float:
        """Steps a second of the reader's clock since the start; 1000 if on time."""
        newest = self.newest()
        return float((newest["number"] + 1) / max(newest["stamp"] - self._start, 1e-9))


def is_ready(folder: Path) -> bool:
    """Whether the simulation of ``folder`` has made its first step."""
    path = folder / "truth.count"
    return path.exists() and path.stat().st_size >= 8 and bool(open_shared(path, _INDEX)[0] > 0)


def ground_truth_trajectory(truth: GroundTruth, recorded: Trajectory, began: float) -> Trajectory:
    """``recorded`` with true positions, velocities and contacts.

    ``began`` s on the reader's clock is the time of its first state. A block touches the hand if a
    finger touches it. Raises `InvalidInputError` if the ground truth is no longer kept.
    """
    at = began + recorded.scene.dt * np.arange(recorded.steps + 1)
    rows = truth.between(at[0] - 0.1, at[-1] + 0.1)
    if not len(rows) or rows["stamp"][0] > at[0]:
        raise InvalidInputError(f"the truth of {at[0]:.3f} s on is no longer kept")
    # Extrapolation from the last step before each state errs by less than 0.01 mm.
    index = np.maximum(np.searchsorted(rows["stamp"], at, side="right") - 1, 0)
    late = (at - rows["stamp"][index])[:, None, None]
    velocity = rows["velocity"][index]
    nodes = recorded.scene.node_count
    contact = np.zeros((len(at), nodes, nodes), bool)
    contact[:, 0, 1:] = contact[:, 1:, 0] = rows["fingers"][index].any(axis=2)
    return replace(
        recorded,
        position=rows["position"][index] + late * velocity,
        velocity=velocity,
        contact=contact,
        tracked=None,
        measured_at=None,
    )


class SceneResetService:
    """The server's end of scene resets: another process asks for a block to be moved."""

    def __init__(self, folder: Path) -> None:
        self._request = create_shared(folder / "orders", _REQUEST, 1)
        self._done = 0

    def execute(self, place: Callable[[int, np.ndarray, float], None]) -> None:
        """Calls ``place(block, position, yaw)`` if there is a request since the last call."""
        asked = int(self._request["asked"][0])
        if asked != self._done:
            request = self._request[0]
            place(int(request["block"]), request["position"].copy(), float(request["yaw"]))
            self._done = asked
            self._request["done"] = asked


def request_block_pose(folder: Path, block: int, position: np.ndarray, yaw: float) -> None:
    """Moves ``block`` to ``position`` [3] m and ``yaw`` rad, and waits until it is there.

    Raises `RuntimeError` if the server does not do so.
    """
    request = open_shared(folder / "orders", _REQUEST, write=True)
    with (folder / "orders.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        asked = int(request["asked"][0]) + 1
        request["block"], request["position"], request["yaw"] = block, position, yaw
        request["asked"] = asked
        until = time.monotonic() + _TIMEOUT
        while int(request["done"][0]) != asked:
            if time.monotonic() > until:
                raise RuntimeError("the simulated robot did not put the block there in 5 s")
            time.sleep(0.001)
