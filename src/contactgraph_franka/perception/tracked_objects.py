"""How far a hand has carried what it holds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from contactgraph_franka.perception.perception import PositionMeasurement
from contactgraph_franka.perception.tracker import (
    FREE,
    GRASPED,
    NEVER_SEEN,
    Estimate,
    FilterState,
    ObjectTracker,
)

_LATE = 0.035
"""s from when fingers are stopped to when they tell: `FingerContact`'s window, and a look."""
_PAUSE = 0.05
"""s between two notes: what happened in between, nobody knows."""
_KEPT = 512
"""Notes, half a second, that frames still ask for that come late."""
_FIRST_ROOM = 1 << 16
"""Notes that there is room for at first: a minute at 1 kHz. Doubled when full, which takes 1 ms."""
_NOTHING = -1


class GraspOffsetHistory:
    """Of ``count`` objects: the hand's way, added up over the time in which it held each.

    Seen from what carries it, an object that is held rests, like one on a table. Whoever tracks
    that sees neither the hand's accelerations nor its own delay.
    """

    def __init__(self, count: int) -> None:
        self._time = np.empty(_FIRST_ROOM)
        self._held = np.empty(_FIRST_ROOM, dtype=int)
        self._hand = np.empty((_FIRST_ROOM, 2, 3))
        self._moved = np.empty((_FIRST_ROOM, count, 3))
        self._notes = 0
        self._still = np.zeros((count, 3))

    def begin(self) -> None:
        """Forgets all but the last half second."""
        first = max(0, self._notes - _KEPT)
        for each in (self._time, self._held, self._hand, self._moved):
            each[: self._notes - first] = each[first : self._notes].copy()
        self._notes -= first

    def append(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, held: int | None = None
    ) -> None:
        """The hand is at ``hand`` [3] m with ``speed`` [3] m/s at ``stamp`` s, and holds an object.

        ``held`` is the object's index; fingers tell of it late, so that it is held since then.
        Stamps no newer than the last change nothing.
        """
        last = self._notes - 1
        if last >= 0 and not stamp > self._time[last]:
            return
        if self._notes == len(self._time):
            self._grow()
        now = self._notes
        self._notes += 1
        self._time[now], self._hand[now, 0], self._hand[now, 1] = stamp, hand, speed
        self._held[now] = _NOTHING if held is None else held
        self._moved[now] = self._moved[last] if last >= 0 else self._still
        if held is None or last < 0 or stamp - self._time[last] > _PAUSE:
            return
        since = now
        while (
            since > 0
            and self._held[since - 1] != held
            and stamp - self._time[since - 1] < _LATE
            and self._time[since] - self._time[since - 1] < _PAUSE
        ):
            since -= 1
        first = max(since - 1, 0)
        self._held[since : now + 1] = held
        self._moved[since : now + 1, held] = self._moved[first, held] + (
            self._hand[since : now + 1, 0] - self._hand[first, 0]
        )

    def displacement(self, index: int, time: float) -> np.ndarray:
        """[3] m: how far object ``index`` had been carried at ``time`` s."""
        if not self._notes:
            return self._still[index]
        at = self._note_at(time)
        moved = self._moved[max(at, 0), index]
        if at == self._notes - 1 and time - self._time[at] < _PAUSE:
            moved = moved + (time - self._time[at]) * self.velocity(index)
        return moved

    def was_grasped(self, index: int, time: float) -> bool:
        """Whether the hand held object ``index`` at ``time`` s, as far as is known by now."""
        at = self._note_at(time)
        return at >= 0 and bool(self._held[at] == index)

    def is_grasped(self, index: int) -> bool:
        """Whether the hand held object ``index`` at the last note."""
        return bool(self._notes and self._held[self._notes - 1] == index)

    def velocity(self, index: int) -> np.ndarray:
        """[3] m/s: how fast object ``index`` is carried at the last note."""
        return self._hand[self._notes - 1, 1] if self.is_grasped(index) else self._still[index]

    def motion(self, index: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[T, 3] m, how far object ``index`` had been carried at the times ``at`` [T] s; and how
        fast, [T, 3] m/s."""
        if not self._notes:
            return np.zeros((len(at), 3)), np.zeros((len(at), 3))
        time = self._time[: self._notes]
        tick = np.clip(np.searchsorted(time, at, side="right") - 1, 0, self._notes - 1)
        moved = self._moved[: self._notes, index]
        path = np.stack([np.interp(at, time, moved[:, axis]) for axis in range(3)], axis=1)
        held = self._held[tick] == index
        return path, np.where(held[:, None], self._hand[tick, 1], 0.0)

    def _note_at(self, time: float) -> int:
        """The last note at ``time`` s; -1 where there is none before."""
        return int(np.searchsorted(self._time[: self._notes], time, side="right")) - 1

    def _grow(self) -> None:
        self._time, self._held, self._hand, self._moved = (
            np.concatenate([each, np.empty_like(each)])
            for each in (self._time, self._held, self._hand, self._moved)
        )


class MeasurementSource(Protocol):
    """Whoever sees objects. `contactgraph_franka.perception.perception.Perception` is one."""

    def since(self, name: str, after: float) -> Sequence[PositionMeasurement]:
        """Where the newest frames exposed after ``after`` s have an object, in order."""


@dataclass(frozen=True, eq=False)
class Track:
    """An object, as it was tracked over a run."""

    carried: GraspOffsetHistory
    index: int
    """Of the object in ``carried``."""
    states: list[FilterState] = field(default_factory=list)
    """At the frames that counted, seen from what carried it."""


class TrackedObjects:
    """Tracks objects, in the order of their nodes; keeps all of it, to be smoothed.

    What the hand holds moves with it: the camera corrects only where in the hand it is.
    """

    def __init__(self, source: MeasurementSource, names: Sequence[str]) -> None:
        """``names`` are those of the nodes after the hand."""
        self._source = source
        self._names = tuple(names)
        self._trackers = [ObjectTracker() for _ in self._names]
        self._asked = [-np.inf] * len(self._names)
        self._carried = GraspOffsetHistory(len(self._names))
        self.begin()

    def begin(self) -> None:
        """Forgets what was kept: a new run."""
        self._carried.begin()
        self.tracks = {1 + index: Track(self._carried, index) for index in range(len(self._names))}
        """By node, since then."""

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """The hand is at ``hand`` [3] m with ``speed`` [3] m/s at ``stamp`` s.

        ``contact``: 1 where its fingers hold ``block``, 0 where not, NaN where that is not known.
        """
        self._carried.append(hand, speed, stamp, block if contact > 0.5 else None)

    def estimates(self, now: float) -> list[Estimate]:
        """Where each object is at ``now`` s."""
        return [self._estimate(index, now) for index in range(len(self._names))]

    def _estimate(self, index: int, now: float) -> Estimate:
        tracker, carried = self._trackers[index], self._carried
        held = carried.is_grasped(index)
        for seen in self._source.since(self._names[index], self._asked[index]):
            self._asked[index] = seen.time
            there = seen.position - carried.displacement(index, seen.time)
            since = seen.time if tracker.state is None else tracker.state.time
            motion = (
                GRASPED
                if carried.was_grasped(index, since) and carried.was_grasped(index, seen.time)
                else FREE
            )
            if tracker.measure(there, seen.covariance, seen.time, motion):
                assert tracker.state is not None
                self.tracks[1 + index].states.append(tracker.state)
        if tracker.state is None:
            return NEVER_SEEN
        moved, speed = carried.displacement(index, now), carried.velocity(index)
        found = tracker.state.estimate(now, GRASPED if held else FREE)
        return Estimate(
            found.position + moved,
            found.velocity + speed,
            found.variance,
            now if held else found.time,  # the hand is measured now, and what it holds with it
            found.tracked,
        )
