"""What the camera's process knows, in memory that the robot's loop reads without waiting."""

from dataclasses import dataclass
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

_TIME, _FRAMES, _LOST = range(3)
_POSITION, _COVARIANCE = slice(3, 6), slice(6, 15)
_NUMBERS = 15
"""Numbers in a slot, by the places above. Plain ones: fields take several times as long to read."""
_SLOTS = 8
"""Of an object. All but the oldest are whole while the next is written, however long its writer
must wait for a core."""
_TOLD = 5
"""Of those, at most so many are told; a reader has three frames' time to copy them."""
_LATENCY = 3
"""Numbers: frames, the sum of their latencies, the longest [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """Where a frame showed an object, in the frame of the robot's base."""

    position: np.ndarray
    """[3] m"""
    covariance: np.ndarray
    """[3, 3] m^2"""
    time: float
    """s: the exposure."""


@dataclass(frozen=True)
class SightCounts:
    """What became of an object in all frames so far."""

    frames: int
    lost: int
    """Frames that did not show it."""


class SharedSightings:
    """The newest sighting of each of ``count`` objects. One process writes, others read."""

    def __init__(self, count: int, context: BaseContext) -> None:
        self._count = count
        self._memory: Any = context.RawArray("d", count * (_SLOTS * _NUMBERS + 1) + _LATENCY)
        self._map()

    def __getstate__(self) -> tuple[int, Any]:
        return self._count, self._memory

    def __setstate__(self, state: tuple[int, Any]) -> None:
        self._count, self._memory = state
        self._map()

    def _map(self) -> None:
        # Each process has its own arrays over the one memory.
        numbers = np.frombuffer(self._memory)
        used = self._count * _SLOTS * _NUMBERS
        self._rows = numbers[:used].reshape(self._count, _SLOTS, _NUMBERS)
        self._latency = numbers[used : used + _LATENCY]
        # How often each was written.
        self._written = numbers[used + _LATENCY :].view(np.int64)

    def write(self, index: int, seen: Measured | None, counts: SightCounts) -> None:
        """Shows an object's newest sighting and its counts; None: no frame has shown it yet."""
        written = int(self._written[index]) + 1
        row = self._rows[index, written % _SLOTS]
        row[_TIME] = -np.inf
        if seen is not None:
            row[_TIME] = seen.time
            row[_POSITION], row[_COVARIANCE] = seen.position, seen.covariance.ravel()
        row[_FRAMES], row[_LOST] = counts.frames, counts.lost
        # Last, and the processors that an arm's library runs on keep to that.
        self._written[index] = written

    def since(self, index: int, after: float = -np.inf) -> list[Measured]:
        """An object's sightings later than ``after`` s, the newest five at most, in order."""
        newest = int(self._written[index])
        # One look at the time first: most who ask have seen all.
        if not newest or not self._rows[index, newest % _SLOTS, _TIME] > after:
            return []
        found: list[Measured] = []
        for row in self._copied(index, _TOLD):
            time = float(row[_TIME])
            # A frame that did not show the object tells once more where it was before.
            if time > after:
                found.append(Measured(row[_POSITION], row[_COVARIANCE].reshape(3, 3), time))
                after = time
        return found

    def counts(self, index: int) -> SightCounts:
        """An object's newest counts."""
        if not self._written[index]:
            return SightCounts(0, 0)
        (row,) = self._copied(index, 1)
        return SightCounts(int(row[_FRAMES]), int(row[_LOST]))

    def add_frame(self, latency: float) -> None:
        """Counts a frame whose estimate came ``latency`` s after its exposure."""
        frames, total, longest = self._latency
        self._latency[:] = frames + 1, total + latency, max(longest, latency)

    def latency(self) -> tuple[int, float, float]:
        """Frames so far, and the mean and the longest time from exposure to estimate [s]."""
        frames, total, longest = self._latency.tolist()
        return int(frames), total / frames if frames else float("nan"), longest

    def _copied(self, index: int, most: int) -> np.ndarray:
        """[K, 15]: the newest K <= ``most`` rows, the oldest first."""
        while True:
            written = int(self._written[index])
            wanted = np.arange(max(written - most, 0) + 1, written + 1)
            rows = self._rows[index, wanted % _SLOTS]
            if self._written[index] - written < _SLOTS - most:
                return rows
