"""Arrays in files that several processes map."""

import fcntl
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory


def create_shared(path: Path, kind: np.dtype, count: int) -> np.ndarray:
    """[count] zeros that whoever opens ``path`` sees change."""
    return np.asarray(np.memmap(path, kind, mode="w+", shape=(count,)))


def open_shared(path: Path, kind: np.dtype, write: bool = False) -> np.ndarray:
    """What `create_shared` made, without copying."""
    return np.asarray(np.memmap(path, kind, mode="r+" if write else "r"))


_KEPT = 1 << 15
"""Ticks that are kept: 32 simulated seconds, so that a run can be read when it is over."""
_MARGIN = 64
"""Ticks before the oldest one that may be overwritten while they are read."""


def ground_truth_dtype(blocks: int, places: int) -> np.dtype:
    """The fields of a tick, for ``blocks`` blocks and a ``qpos`` of ``places`` numbers.

    Nodes are the hand's grasp point and the blocks. Positions in the frame of the arm's base.
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
            ("again", "i8"),  # the tick once more: one that is being written has two
        ]
    )


class GroundTruthWriter:
    """Writes a tick at a time. ``row`` is filled by the caller, then `publish` shows it."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        kind = ground_truth_dtype(blocks, places)
        self._rows = create_shared(folder / "truth", kind, _KEPT)
        self._rows["tick"] = self._rows["again"] = -1
        self._newest = create_shared(folder / "newest", np.dtype("i8"), 1)
        self._newest[0] = -1
        self.row = np.zeros(1, kind)

    def publish(self, tick: int) -> None:
        """Shows ``row`` as that of ``tick``, which count from 0."""
        self.row["tick"] = self.row["again"] = tick
        # In this order, which the processors that an arm's library runs on keep.
        self._rows[tick % _KEPT : tick % _KEPT + 1] = self.row
        self._newest[0] = tick


class GroundTruth:
    """Reads what `GroundTruthWriter` wrote, from any process."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        self._rows = open_shared(folder / "truth", ground_truth_dtype(blocks, places))
        self._newest = open_shared(folder / "newest", np.dtype("i8"))

    def newest(self) -> np.void:
        """The newest tick, with the fields of `ground_truth_dtype`."""
        while True:
            tick = int(self._newest[0])
            row = self._rows[tick % _KEPT].copy()
            if row["tick"] == row["again"] == tick:
                return row

    def since(self, tick: int) -> np.ndarray:
        """[K]: the ticks after ``tick`` that are still kept, in order."""
        newest = int(self._newest[0])
        first = max(tick + 1, newest + 1 - _KEPT + _MARGIN, 0)
        rows = self._rows[np.arange(first, newest + 1) % _KEPT]
        whole = (rows["tick"] == np.arange(first, newest + 1)) & (rows["again"] == rows["tick"])
        return rows[whole]

    def between(self, begin: float, end: float) -> np.ndarray:
        """[K]: the kept ticks with stamps from ``begin`` to ``end`` s on the reader's clock."""
        rows = self.since(-1)
        return rows[(rows["stamp"] >= begin) & (rows["stamp"] <= end)]


def ground_truth_trajectory(truth: GroundTruth, run: Trajectory, began: float) -> Trajectory:
    """``run`` with the true places, velocities and contacts at its states.

    ``began`` s on the reader's clock is when its first state was. A block touches the hand where a
    finger touches it. Raises `InvalidInputError` where the truth of so long ago is no longer kept.
    """
    at = began + run.scene.dt * np.arange(run.steps + 1)
    rows = truth.between(at[0] - 0.1, at[-1] + 0.1)
    if not len(rows) or rows["stamp"][0] > at[0]:
        raise InvalidInputError(f"the truth of {at[0]:.3f} s on is no longer kept")
    # The last tick before each state; what is between two is less than a hundredth of a millimetre.
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


_ORDER = np.dtype(
    [("asked", "i8"), ("done", "i8"), ("block", "i8"), ("position", "f8", (3,)), ("yaw", "f8")]
)
_PATIENCE = 5.0
"""s, on the wall."""


class SceneResetService:
    """The server's end."""

    def __init__(self, folder: Path) -> None:
        self._order = create_shared(folder / "orders", _ORDER, 1)
        self._done = 0

    def carry_out(self, place: Callable[[int, np.ndarray, float], None]) -> None:
        """Calls ``place(block, position, yaw)`` where something was asked since the last call."""
        asked = int(self._order["asked"][0])
        if asked != self._done:
            order = self._order[0]
            place(int(order["block"]), order["position"].copy(), float(order["yaw"]))
            self._done = asked
            self._order["done"] = asked


def request_block_pose(folder: Path, block: int, position: np.ndarray, yaw: float) -> None:
    """Has ``block`` put at ``position`` [3] m, turned by ``yaw`` rad, and waits until it is.

    Raises `RuntimeError` where the server does not do so.
    """
    order = open_shared(folder / "orders", _ORDER, write=True)
    with (folder / "orders.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        asked = int(order["asked"][0]) + 1
        order["block"], order["position"], order["yaw"] = block, position, yaw
        order["asked"] = asked
        until = time.monotonic() + _PATIENCE
        while int(order["done"][0]) != asked:
            if time.monotonic() > until:
                raise RuntimeError("the rehearsal's server did not put the block there in 5 s")
            time.sleep(0.001)


_COUNTERS = np.dtype(
    {
        "names": ["places", "ready", "ticks", "late", "dropped", "began", "now", "busy", "latest"],
        "formats": ["i8"] * 5 + ["f8"] * 4,
    }
)
_LATE = 0.5
"""Of a tick: begun later than this, it counts as late."""


@dataclass(frozen=True)
class ServerReport:
    """How well the server kept time, since its start."""

    ticks: int
    late: int
    """Ticks begun more than half a tick late."""
    dropped: int
    """Ticks that never were, since the server was too far behind."""
    rate: float
    """Ticks a second on the wall; 1000 / pace is on time."""
    busy: float
    """Share of the time in which it worked."""
    latest: float
    """s, on the wall: the latest that a tick began."""


class ServerCounters:
    """The server's end. ``places`` is the length of MuJoCo's ``qpos``."""

    def __init__(self, folder: Path, places: int, period: float) -> None:
        self._shared = create_shared(folder / "counters", _COUNTERS, 1)
        self._shared["places"] = places
        self._late_after = _LATE * period

    def start(self, now: float) -> None:
        """From ``now`` s on, the server serves."""
        self._shared["began"] = self._shared["now"] = now
        self._shared["ready"] = 1

    def count(self, ticks: int, now: float, worked: float, behind: float) -> None:
        """After a tick that began ``behind`` s late and took ``worked`` s."""
        shared = self._shared
        shared["ticks"], shared["now"] = ticks, now
        shared["busy"] += worked
        if behind > self._late_after:
            shared["late"] += 1
            shared["latest"] = max(shared["latest"][0], behind)

    def drop(self, ticks: int) -> None:
        """That so many ticks were left out."""
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
    """How many numbers MuJoCo's ``qpos`` has; the server must be ready."""
    return int(open_shared(folder / "counters", _COUNTERS)["places"][0])
