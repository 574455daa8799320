"""Where objects are, from what a camera sees and a hand holds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from contactgraph_franka.perception.carried_path import CarriedPath
from contactgraph_franka.perception.shared_sightings import Measured
from contactgraph_franka.perception.tracker import (
    FREE,
    HELD,
    NEVER_SEEN,
    Estimate,
    FilterState,
    ObjectTracker,
)


class SightSource(Protocol):
    """Whoever sees objects. `contactgraph_franka.perception.perception.Perception` is one."""

    def since(self, name: str, after: float) -> Sequence[Measured]:
        """Where the newest frames exposed after ``after`` s have an object, in order."""


@dataclass(frozen=True, eq=False)
class Track:
    """An object, as it was tracked over a run."""

    carried: CarriedPath
    index: int
    """Of the object in ``carried``."""
    states: list[FilterState] = field(default_factory=list)
    """At the frames that counted, seen from what carried it."""


class SeenObjects:
    """Tracks objects, in the order of their nodes; keeps all of it, to be smoothed.

    What the hand holds moves with it: the camera corrects only where in the hand it is.
    """

    def __init__(self, source: SightSource, names: Sequence[str]) -> None:
        """``names`` are those of the nodes after the hand."""
        self._source = source
        self._names = tuple(names)
        self._trackers = [ObjectTracker() for _ in self._names]
        self._asked = [-np.inf] * len(self._names)
        self._carried = CarriedPath(len(self._names))
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
        self._carried.note(hand, speed, stamp, block if contact > 0.5 else None)

    def estimates(self, now: float) -> list[Estimate]:
        """Where each object is at ``now`` s."""
        return [self._estimate(index, now) for index in range(len(self._names))]

    def _estimate(self, index: int, now: float) -> Estimate:
        tracker, carried = self._trackers[index], self._carried
        held = carried.holds(index)
        for seen in self._source.since(self._names[index], self._asked[index]):
            self._asked[index] = seen.time
            there = seen.position - carried.moved(index, seen.time)
            since = seen.time if tracker.state is None else tracker.state.time
            motion = HELD if carried.held(index, since) and carried.held(index, seen.time) else FREE
            if tracker.measure(there, seen.covariance, seen.time, motion):
                assert tracker.state is not None
                self.tracks[1 + index].states.append(tracker.state)
        if tracker.state is None:
            return NEVER_SEEN
        moved, speed = carried.moved(index, now), carried.speed(index)
        found = tracker.state.estimate(now, HELD if held else FREE)
        return Estimate(
            found.position + moved,
            found.velocity + speed,
            found.variance,
            now if held else found.time,  # the hand is measured now, and what it holds with it
            found.tracked,
        )
