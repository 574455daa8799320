"""Tracking of objects that a camera observes and a hand carries."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from contactgraph_franka.perception.camera import AHEAD
from contactgraph_franka.perception.tracker import (
    FREE,
    GRASPED,
    NEVER_SEEN,
    Estimate,
    FilterState,
    ObjectTracker,
)

if TYPE_CHECKING:
    from contactgraph_franka.perception.perception import Perception

_FINGER_DELAY = 0.035
"""s from stopped fingers to their report: `FingerContact`'s window and one reading."""
_PAUSE = 0.05  # s between two entries beyond which the motion in between is unknown
_KEPT = 512  # Entries, half a second, that delayed frames still refer to
_CAPACITY = 1 << 16  # Initial number of entries, a minute at 1 kHz. Doubling takes 1 ms
_NOTHING = -1


class GraspOffsetHistory:
    """The hand's displacement while it grasped each of ``count`` objects, summed up over time.

    An object that is grasped rests relative to this displacement, as one on a table does. A
    tracker of the difference is affected neither by the hand's accelerations nor by its delay.
    """

    def __init__(self, count: int) -> None:
        fields: list[tuple] = [("time", "f8"), ("grasped", "i8")]
        fields += [("hand", "f8", (2, 3)), ("sum", "f8", (count, 3))]
        self._entries = np.empty(_CAPACITY, np.dtype(fields))
        self._map()
        self._count = 0
        self._zero = np.zeros((count, 3))

    def begin(self) -> None:
        """Discards all but the last half second."""
        kept = self._entries[max(0, self._count - _KEPT) : self._count].copy()
        self._entries[: len(kept)] = kept
        self._count = len(kept)

    def append(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, held: int | None = None
    ) -> None:
        """Adds the hand's position [3] m and velocity [3] m/s at ``stamp`` s.

        ``held`` is the index of the grasped object. Fingers report a grasp late, so it is dated
        back by their delay. Stamps no newer than the last are ignored.
        """
        last = self._count - 1
        if last >= 0 and not stamp > self._time[last]:
            return
        if self._count == len(self._entries):
            self._entries = np.concatenate([self._entries, np.empty_like(self._entries)])
            self._map()
        now = self._count
        self._count += 1
        self._time[now], self._hand[now, 0], self._hand[now, 1] = stamp, hand, speed
        self._grasped[now] = _NOTHING if held is None else held
        self._sum[now] = self._sum[last] if last >= 0 else self._zero
        if held is None or last < 0 or stamp - self._time[last] > _PAUSE:
            return
        since = now
        while (
            since > 0
            and self._grasped[since - 1] != held
            and stamp - self._time[since - 1] < _FINGER_DELAY
            and self._time[since] - self._time[since - 1] < _PAUSE
        ):
            since -= 1
        first = max(since - 1, 0)
        self._grasped[since : now + 1] = held
        self._sum[since : now + 1, held] = self._sum[first, held] + (
            self._hand[since : now + 1, 0] - self._hand[first, 0]
        )

    def displacement(self, index: int, time: float) -> np.ndarray:
        """[3] m: how far object ``index`` had been carried at ``time`` s."""
        if not self._count:
            return self._zero[index]
        at = self._index_at(time)
        moved = self._sum[max(at, 0), index]
        if at == self._count - 1 and time - self._time[at] < _PAUSE:
            moved = moved + (time - self._time[at]) * self.velocity(index)
        return moved

    def was_grasped(self, index: int, time: float) -> bool:
        """Whether the hand grasped object ``index`` at ``time`` s."""
        at = self._index_at(time)
        return at >= 0 and bool(self._grasped[at] == index)

    def is_grasped(self, index: int) -> bool:
        """Whether the hand grasped object ``index`` at the last entry."""
        return bool(self._count and self._grasped[self._count - 1] == index)

    def velocity(self, index: int) -> np.ndarray:
        """[3] m/s: the velocity at which object ``index`` is carried at the last entry."""
        return self._hand[self._count - 1, 1] if self.is_grasped(index) else self._zero[index]

    def motion(self, index: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacements [T, 3] m and velocities [T, 3] m/s of object ``index`` at ``at`` [T] s."""
        if not self._count:
            return np.zeros((len(at), 3)), np.zeros((len(at), 3))
        time = self._time[: self._count]
        entry = np.clip(np.searchsorted(time, at, side="right") - 1, 0, self._count - 1)
        moved = self._sum[: self._count, index]
        path = np.stack([np.interp(at, time, moved[:, axis]) for axis in range(3)], axis=1)
        grasped = self._grasped[entry] == index
        return path, np.where(grasped[:, None], self._hand[entry, 1], 0.0)

    def _index_at(self, time: float) -> int:
        """The last entry at ``time`` s; -1 before the first."""
        return int(np.searchsorted(self._time[: self._count], time, side="right")) - 1

    def _map(self) -> None:
        self._time, self._grasped, self._hand, self._sum = (
            self._entries[name] for name in ("time", "grasped", "hand", "sum")
        )


@dataclass(frozen=True, eq=False)
class Track:
    """One object over one trajectory."""

    carried: GraspOffsetHistory
    index: int
    """Index of the object in ``carried``."""
    states: list[FilterState] = field(default_factory=list)
    """At the accepted frames, relative to the carried displacement."""


class TrackedObjects:
    """Tracks objects in the order of their nodes, and keeps their states for smoothing.

    A grasped object moves with the hand; the camera corrects only its offset in the hand.
    """

    def __init__(self, source: "Perception", names: Sequence[str]) -> None:
        """``names`` are those of the nodes after the hand."""
        self._source = source
        self._names = tuple(names)
        self._trackers = [ObjectTracker() for _ in self._names]
        self._newest = [-np.inf] * len(self._names)
        self._carried = GraspOffsetHistory(len(self._names))
        self.begin()

    def begin(self) -> None:
        """Starts a new trajectory."""
        self._carried.begin()
        self.tracks = {1 + index: Track(self._carried, index) for index in range(len(self._names))}
        """By node, since then."""

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """Adds the hand's position [3] m and velocity [3] m/s at ``stamp`` s.

        ``contact``: 1 if its fingers hold ``block``, 0 if not, NaN if unknown.
        """
        self._carried.append(hand, speed, stamp, block if contact > 0.5 else None)

    def estimates(self, now: float) -> list[Estimate]:
        """The estimate of each object at ``now`` s."""
        return [self._estimate(index, now) for index in range(len(self._names))]

    def _estimate(self, index: int, now: float) -> Estimate:
        tracker, carried = self._trackers[index], self._carried
        for measurement in self._source.since(self._names[index], self._newest[index]):
            if measurement.time > now + AHEAD:
                continue
            self._newest[index] = measurement.time
            offset = measurement.position - carried.displacement(index, measurement.time)
            since = measurement.time if tracker.state is None else tracker.state.time
            grasped = all(carried.was_grasped(index, time) for time in (since, measurement.time))
            motion = GRASPED if grasped else FREE
            if tracker.measure(offset, measurement.covariance, measurement.time, motion):
                assert tracker.state is not None
                self.tracks[1 + index].states.append(tracker.state)
        if tracker.state is None:
            return NEVER_SEEN
        grasped = carried.is_grasped(index)
        relative = tracker.state.estimate(now, GRASPED if grasped else FREE)
        return Estimate(
            relative.position + carried.displacement(index, now),
            relative.velocity + carried.velocity(index),
            relative.variance,
            now if grasped else relative.time,  # the hand, and with it the object, is measured now
            relative.tracked,
        )
