"""What the camera's process knows, in memory that the robot's loop reads without waiting."""

from dataclasses import dataclass
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from contactgraph.robot.perception.tracker import FilterState

_TIME, _BEGUN, _DENSITY, _FRAMES, _LOST, _REFUSED = range(6)
_MEAN, _COVARIANCE = slice(6, 12), slice(12, 48)
_TRACK = 48
"""Numbers in a slot, by the places above. Plain ones: fields take several times as long to read."""
_SLOTS = 4
"""Of an object. The newest is whole while the next is written, however long its writer must wait
for a core; a reader has three frames' time to copy one."""
_LATENCY = 3
"""Numbers: frames, the sum of their latencies, the longest [s]."""


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
        self._memory: Any = context.RawArray("d", count * (_SLOTS * _TRACK + 1) + _LATENCY)
        self._map()

    def __getstate__(self) -> tuple[int, Any]:
        return self._count, self._memory

    def __setstate__(self, state: tuple[int, Any]) -> None:
        self._count, self._memory = state
        self._map()

    def _map(self) -> None:
        # Each process has its own arrays over the one memory.
        numbers = np.frombuffer(self._memory)
        used = self._count * _SLOTS * _TRACK
        self._rows = numbers[:used].reshape(self._count, _SLOTS, _TRACK)
        self._latency = numbers[used : used + _LATENCY]
        # How often each was written.
        self._written = numbers[used + _LATENCY :].view(np.int64)

    def write(self, index: int, state: FilterState | None, counts: TrackCounts) -> None:
        """Shows an object's state and counts; None: not seen yet."""
        written = int(self._written[index]) + 1
        row = self._rows[index, written % _SLOTS]
        row[_TIME] = -np.inf
        if state is not None:
            row[_TIME], row[_BEGUN], row[_DENSITY] = state.time, state.begun, state.density
            row[_MEAN], row[_COVARIANCE] = state.mean, state.covariance.ravel()
        row[_FRAMES], row[_LOST], row[_REFUSED] = counts.frames, counts.lost, counts.refused
        # Last, and the processors that an arm's library runs on keep to that.
        self._written[index] = written

    def state(self, index: int) -> FilterState | None:
        """An object's newest state; None where no frame has shown it yet."""
        if not self._written[index]:
            return None
        row = self._newest(index)
        time, begun, density = row[:_FRAMES].tolist()
        if time == -np.inf:
            return None
        return FilterState(time, row[_MEAN], row[_COVARIANCE].reshape(6, 6), begun, density)

    def counts(self, index: int) -> TrackCounts:
        """An object's newest counts."""
        row = self._newest(index)
        return TrackCounts(*(int(row[each]) for each in (_FRAMES, _LOST, _REFUSED)))

    def add_frame(self, latency: float) -> None:
        """Counts a frame whose estimate came ``latency`` s after its exposure."""
        frames, total, longest = self._latency
        self._latency[:] = frames + 1, total + latency, max(longest, latency)

    def latency(self) -> tuple[int, float, float]:
        """Frames so far, and the mean and the longest time from exposure to estimate [s]."""
        frames, total, longest = self._latency.tolist()
        return int(frames), total / frames if frames else float("nan"), longest

    def _newest(self, index: int) -> np.ndarray:
        while True:
            written = int(self._written[index])
            row = self._rows[index, written % _SLOTS].copy()
            if self._written[index] - written < _SLOTS - 1:
                return row
