"""Times that a camera tells, on the clock of whoever reads it."""

import time
from collections import deque
from collections.abc import Callable

_KEPT = 300
"""Frames, ten seconds at 30 Hz: a device's clock drifts by a millisecond in minutes."""


class FrameClock:
    """Maps times of a camera to ``clock``, which need not be the system's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._ways: deque[float] = deque(maxlen=_KEPT)

    def from_epoch(self, moment: float) -> float:
        """s, of a time since 1970 that the system's clock tells as well."""
        return self._clock() - (time.time() - moment)

    def from_device(self, moment: float) -> float:
        """s, of a time on the device's own clock, at the arrival of the frame it belongs to.

        The two clocks' difference is that of the frame that came quickest of the last 300. What
        even that one needed to come is not seen: times are late by so much, some milliseconds.
        """
        self._ways.append(self._clock() - moment)
        return moment + min(self._ways)
