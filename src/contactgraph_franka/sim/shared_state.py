"""Memory that the simulated robot's processes share: ground truth, scene resets, timing."""

import fcntl
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory

_KEPT = 1 << 15
"""Control steps kept: 32 simulated seconds, so that an episode can be read when it is over."""
_MARGIN = 64
"""Oldest steps that may be overwritten while they are read."""
_REQUEST = np.dtype(
    [("asked", "i8"), ("done", "i8"), ("block", "i8"), ("position", "f8", (3,)), ("yaw", "f8")]
)
_TIMEOUT = 5.0
"""Wall time to wait for a scene reset, s."""
_COUNTERS = np.dtype(
    {
        "names": ["places", "ready", "ticks", "late", "dropped", "began", "now", "busy", "latest"],
        "formats": ["i8"] * 5 + ["f8"] * 4,
    }
)
_LATE = 0.5
"""Delay of a late control step, in steps."""


def create_shared(path: Path, dtype: np.dtype, count: int) -> np.ndarray:
    """[count] zeros in a file that several processes map."""
    return np.asarray(np.memmap(path, dtype, mode="w+", shape=(count,)))


def open_shared(path: Path, dtype: np.dtype, write: bool = False) -> np.ndarray:
    """The array of `create_shared`, without copying."""
    return np.asarray(np.memmap(path, dtype, mode="r+" if write else "r"))


def ground_truth_dtype(blocks: int, places: int) -> np.dtype:
    """The fields of a control step, for ``blocks`` blocks and a ``qpos`` of ``places`` numbers.

    Nodes are the hand's grasp point and the blocks. Positions are in the frame of the arm's base.
    """
    return np.dtype(
        [
            ("tick", "i8"),
            ("time", "f8"),  # s, simulated since the start
            ("stamp", "f8"),  # s, on the reader's clock
            ("position", "f8", (1 + blocks, 3)),  # m
            ("velocity", "f8", (1 + blocks, 3)),  # m/s
            ("turn", "f8", (1 + blocks, 4)),  # unit quaternions, the real part first
            ("fingers", "?", (blocks, 2)),  # whether the left, the right finger touches
            ("standing", "?", (blocks,)),  # whether it touches the table
            ("width", "f8"),  # m between the fingers
            ("places", "f8", (places,)),  # MuJoCo's qpos, for a renderer
            ("again", "i8"),  # the tick again: the two differ while a row is written
        ]
    )


class GroundTruthWriter:
    """Writes a control step at a time: the caller fills ``row``, then calls `publish`."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        dtype = ground_truth_dtype(blocks, places)
        self._rows = create_shared(folder / "truth", dtype, _KEPT)
        self._rows["tick"] = self._rows["again"] = -1
        self._newest = create_shared(folder / "newest", np.dtype("i8"), 1)
        self._newest[0] = -1
        self.row = np.zeros(1, dtype)

    def publish(self, tick: int) -> None:
        """Publishes ``row`` as that of step ``tick``, which counts from 0."""
        self.row["tick"] = self.row["again"] = tick
        # The processors that the arm's library supports keep this order of writes.
        self._rows[tick % _KEPT : tick % _KEPT + 1] = self.row
        self._newest[0] = tick


class GroundTruth:
    """Reads the control steps of `GroundTruthWriter`, from any process."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        self._rows = open_shared(folder / "truth", ground_truth_dtype(blocks, places))
        self._newest = open_shared(folder / "newest", np.dtype("i8"))

    def newest(self) -> np.void:
        """The newest step, with the fields of `ground_truth_dtype`."""
        while True:
            tick = int(self._newest[0])
            row = self._rows[tick % _KEPT].copy()
            if row["tick"] == row["again"] == tick:
                return row

    def since(self, tick: int) -> np.ndarray:
        """[K]: the kept steps after ``tick``, in order."""
        newest = int(self._newest[0])
        first = max(tick + 1, newest + 1 - _KEPT + _MARGIN, 0)
        rows = self._rows[np.arange(first, newest + 1) % _KEPT]
        valid = (rows["tick"] == np.arange(first, newest + 1)) & (rows["again"] == rows["tick"])
        return rows[valid]

    def between(self, begin: float, end: float) -> np.ndarray:
        """[K]: the kept steps with stamps from ``begin`` to ``end`` s on the reader's clock."""
        rows = self.since(-1)
        return rows[(rows["stamp"] >= begin) & (rows["stamp"] <= end)]


def ground_truth_trajectory(truth: GroundTruth, run: Trajectory, began: float) -> Trajectory:
    """``run`` with true positions, velocities and contacts.

    ``began`` s on the reader's clock is the time of its first state. A block touches the hand if a
    finger touches it. Raises `InvalidInputError` if the ground truth is no longer kept.
    """
    at = began + run.scene.dt * np.arange(run.steps + 1)
    rows = truth.between(at[0] - 0.1, at[-1] + 0.1)
    if not len(rows) or rows["stamp"][0] > at[0]:
        raise InvalidInputError(f"the truth of {at[0]:.3f} s on is no longer kept")
    # Extrapolation from the last step before each state errs by less than 0.01 mm.
    index = np.maximum(np.searchsorted(rows["stamp"], at, side="right") - 1, 0)
    late = (at - rows["stamp"][index])[:, None, None]
    velocity = rows["velocity"][index]
    nodes = run.scene.node_count
    contact = np.zeros((len(at), nodes, nodes), bool)
    contact[:, 0, 1:] = contact[:, 1:, 0] = rows["fingers"][index].any(axis=2)
    return replace(
        run,
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


@dataclass(frozen=True)
class ServerReport:
    """Timing of the server since its start."""

    ticks: int
    late: int
    """Control steps begun more than half a step late."""
    dropped: int
    """Control steps left out, since the server was too late."""
    rate: float
    """Control steps a second of wall time; 1000 / pace is on time."""
    busy: float
    """Share of the time in which it worked."""
    latest: float
    """s of wall time: the largest delay of a step."""


class ServerCounters:
    """The server's end of its report. ``places`` is the length of MuJoCo's ``qpos``."""

    def __init__(self, folder: Path, places: int, period: float) -> None:
        self._shared = create_shared(folder / "counters", _COUNTERS, 1)
        self._shared["places"] = places
        self._late_after = _LATE * period

    def start(self, now: float) -> None:
        """Marks the server as ready from ``now`` s on."""
        self._shared["began"] = self._shared["now"] = now
        self._shared["ready"] = 1

    def count(self, ticks: int, now: float, worked: float, behind: float) -> None:
        """Counts a step that began ``behind`` s late and took ``worked`` s."""
        shared = self._shared
        shared["ticks"], shared["now"] = ticks, now
        shared["busy"] += worked
        if behind > self._late_after:
            shared["late"] += 1
            shared["latest"] = max(shared["latest"][0], behind)

    def drop(self, ticks: int) -> None:
        """Counts steps that were left out."""
        self._shared["dropped"] += ticks


def read_report(folder: Path) -> ServerReport | None:
    """The report of the server of ``folder``; None before it is ready."""
    path = folder / "counters"
    if not path.exists() or path.stat().st_size < _COUNTERS.itemsize:
        return None
    counters = open_shared(path, _COUNTERS)[0]
    if not counters["ready"]:
        return None
    span = max(float(counters["now"] - counters["began"]), 1e-9)
    return ServerReport(
        ticks=int(counters["ticks"]),
        late=int(counters["late"]),
        dropped=int(counters["dropped"]),
        rate=float(counters["ticks"]) / span,
        busy=float(counters["busy"]) / span,
        latest=float(counters["latest"]),
    )


def read_places(folder: Path) -> int:
    """The length of MuJoCo's ``qpos``; the server must be ready."""
    return int(open_shared(folder / "counters", _COUNTERS)["places"][0])
