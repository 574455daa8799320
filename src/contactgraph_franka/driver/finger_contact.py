"""Whether fingers hold something, from their width alone."""

import math
from collections import deque

FALSE_ALARM = 0.02
"""How often fingers that close on nothing seem to be stopped (see `docs/real-arm.md`)."""
MISS = 0.05
"""How often fingers that are stopped seem not to be."""
DELAY = 0.05
"""s, at most, from the touch to when it is told."""
_WINDOW = 0.03
"""s over which the fingers' motion is measured."""
_MOVED = 0.003
"""m that the fingers must have come before anything can have stopped them."""
_STOPPED = 0.01
"""m/s: fingers that close at a tenth of their speed are stopped."""
_EMPTY = 0.005
"""m: fingers this close to each other hold nothing that is meant to be held."""


class FingerContact:
    """Fingers that close, and stop before they meet, have something between them.

    A weak sensor: it says something only from when the fingers close, and what it says comes late.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, float]] = deque()
        self.reset()

    def reset(self) -> None:
        """Nothing is known."""
        self.value = math.nan
        """1: something is between the fingers. 0: nothing is. NaN: it cannot be told."""
        self._past.clear()
        self._begun: float | None = None

    def step(self, width: float, now: float, closing: bool) -> None:
        """The fingers are ``width`` m apart at ``now`` s; ``closing``: that is what they are to."""
        if not closing:
            self.reset()
            return
        if self._begun is None:
            self._begun = width
        self._past.append((now, width))
        while now - self._past[0][0] > _WINDOW and now - self._past[1][0] >= _WINDOW:
            self._past.popleft()
        began, before = self._past[0]
        if width < _EMPTY:
            self.value = 0.0
        elif self._begun - width > _MOVED and now - began >= _WINDOW:
            self.value = float(before - width < _STOPPED * (now - began))
        else:
            self.value = math.nan
