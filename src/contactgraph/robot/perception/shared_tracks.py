"""What the camera's process knows, in memory that the robot's loop reads without waiting."""

from dataclasses import dataclass
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from contactgraph.robot.perception.tracker import FilterState

_TRACK = np.dtype(
    [
        ("number", "i8"),
        ("time", "f8"),  # s
        ("mean", "f8", (6,)),  # m, m/s
        ("covariance", "f8", (6, 6)),
        ("begun", "f8"),  # s
        ("density", "f8"),  # m^2/s^3
        ("frames", "i8"),  # in which it was looked for
        ("lost", "i8"),  # of these, without it
        ("refused", "i8"),  # measurements that did not count
        ("again", "i8"),  # the number once more: a row that is being written has two
    ]
)
_COUNTS = np.dtype([("frames", "i8"), ("latency_sum", "f8"), ("latency_most", "f8")])
_TRIES = 100
"""Reads until one is whole; a write takes microseconds, thirty times a second."""


@dataclass(frozen=True)
class TrackCounts:
    """What became of an object in all frames so far."""

    frames: int
    lost: int
    """Frames that did not show it."""
    refused: int
    """Frames that showed it where it cannot have been, or were no newer than the one before."""


class SharedTracks:
    """The newest state of each of ``count`` objects. One process writes, others read."""

    def __init__(self, count: int, context: BaseContext) -> None:
        self._count = count
        self._memory: Any = context.RawArray("b", count * _TRACK.itemsize + _COUNTS.itemsize)
        self._map()

    def __getstate__(self) -> tuple[int, Any]:
        return self._count, self._memory

    def __setstate__(self, state: tuple[int, Any]) -> None:
        self._count, self._memory = state
        self._map()

    def _map(self) -> None:
        # Each process has its own arrays over the one memory.
        held = memoryview(self._memory).cast("B")
        self._rows = np.frombuffer(held, _TRACK, self._count)
        self._counts = np.frombuffer(held, _COUNTS, 1, self._count * _TRACK.itemsize)

    def write(self, index: int, state: FilterState | None, counts: TrackCounts) -> None:
        """Shows an object's state and counts; None: not seen yet."""
        row = self._rows[index]
        number = int(row["number"]) + 1
        # In this order, which the processors that an arm's library runs on keep.
        row["number"] = number
        if state is not None:
            row["time"], row["mean"] = state.time, state.mean
            row["covariance"] = state.covariance
            row["begun"], row["density"] = state.begun, state.density
        else:
            row["time"] = -np.inf
        row["frames"], row["lost"], row["refused"] = counts.frames, counts.lost, counts.refused
        row["again"] = number

    def state(self, index: int) -> FilterState | None:
        """An object's newest state; None where no frame has shown it yet."""
        row = self._whole(index)
        time = float(row["time"])
        if row["number"] == 0 or time == -np.inf:
            return None
        begun, density = float(row["begun"]), float(row["density"])
        return FilterState(time, row["mean"], row["covariance"], begun, density)

    def counts(self, index: int) -> TrackCounts:
        """An object's newest counts."""
        row = self._whole(index)
        return TrackCounts(int(row["frames"]), int(row["lost"]), int(row["refused"]))

    def add_frame(self, latency: float) -> None:
        """Counts a frame whose estimate came ``latency`` s after its exposure."""
        counts = self._counts[0]
        counts["latency_sum"] += latency
        counts["latency_most"] = max(float(counts["latency_most"]), latency)
        counts["frames"] += 1

    def latency(self) -> tuple[int, float, float]:
        """Frames so far, and the mean and the longest time from exposure to estimate [s]."""
        counts = self._counts[0]
        frames = int(counts["frames"])
        mean = float(counts["latency_sum"]) / frames if frames else float("nan")
        return frames, mean, float(counts["latency_most"])

    def _whole(self, index: int) -> np.void:
        for _ in range(_TRIES):
            row = self._rows[index].copy()
            if row["number"] == row["again"] and row["again"] == self._rows[index]["number"]:
                return row
        raise RuntimeError("the camera's process died while it wrote an estimate")
