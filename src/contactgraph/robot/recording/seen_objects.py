"""What a camera sees, as an arm's readings tell it, and written down on the way."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from contactgraph.robot.perception.tracker import NEVER_SEEN, Estimate, FilterState


class TrackSource(Protocol):
    """Whoever tracks objects. `contactgraph.robot.perception.perception.Perception` is one."""

    def states(self) -> Mapping[str, FilterState | None]:
        """The newest state of each object by name; None: not seen yet. Takes microseconds."""


class SeenObjects:
    """Objects in the order of their nodes; keeps every state of their trackers, to be smoothed."""

    def __init__(self, source: TrackSource, names: Sequence[str]) -> None:
        """``names`` are those of the nodes after the hand."""
        self._source = source
        self._names = tuple(names)
        self.begin()

    def begin(self) -> None:
        """Forgets what was kept: a new run."""
        self.tracks: dict[int, list[FilterState]] = {
            node: [] for node in range(1, len(self._names) + 1)
        }
        """By node, the states at the frames that counted since."""

    def estimates(self, now: float) -> list[Estimate]:
        """Where each object is at ``now`` s."""
        found = []
        states = self._source.states()
        for name, track in zip(self._names, self.tracks.values(), strict=True):
            state = states.get(name)
            if state is None:
                found.append(NEVER_SEEN)
                continue
            if not track or state.time > track[-1].time:
                track.append(state)
            found.append(state.estimate(now))
        return found
