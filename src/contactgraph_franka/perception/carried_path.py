"""How far a hand has carried what it holds."""

import numpy as np

_LATE = 0.035
"""s from when fingers are stopped to when they tell: `FingerContact`'s window, and a look."""
_PAUSE = 0.05
"""s between two notes: what happened in between, nobody knows."""
_KEPT = 512
"""Notes, half a second, that frames still ask for that come late."""
_FIRST_ROOM = 1 << 16
"""Notes that there is room for at first: a minute at 1 kHz. Doubled when full, which takes 1 ms."""
_NOTHING = -1


class CarriedPath:
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

    def note(
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

    def moved(self, index: int, time: float) -> np.ndarray:
        """[3] m: how far object ``index`` had been carried at ``time`` s."""
        if not self._notes:
            return self._still[index]
        at = self._note_at(time)
        moved = self._moved[max(at, 0), index]
        if at == self._notes - 1 and time - self._time[at] < _PAUSE:
            moved = moved + (time - self._time[at]) * self.speed(index)
        return moved

    def held(self, index: int, time: float) -> bool:
        """Whether the hand held object ``index`` at ``time`` s, as far as is known by now."""
        at = self._note_at(time)
        return at >= 0 and bool(self._held[at] == index)

    def holds(self, index: int) -> bool:
        """Whether the hand held object ``index`` at the last note."""
        return bool(self._notes and self._held[self._notes - 1] == index)

    def speed(self, index: int) -> np.ndarray:
        """[3] m/s: how fast object ``index`` is carried at the last note."""
        return self._hand[self._notes - 1, 1] if self.holds(index) else self._still[index]

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
