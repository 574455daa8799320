"""The one clock that readings, commands and the loop share."""

import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time in s, and waits for it."""

    def __call__(self) -> float:
        """s, now."""

    def wait_until(self, moment: float) -> None:
        """Returns at ``moment`` s, or at once where that has passed."""


class WallClock:
    """The same in all processes of a machine; at a ``pace`` of 2 it runs half as fast.

    A simulated arm whose server cannot hold real time runs at such a pace; an arm, at 1.
    """

    def __init__(self, pace: float = 1.0) -> None:
        self.pace = pace
        """Wall seconds to a second of this clock."""

    def __call__(self) -> float:
        """s, now."""
        return time.monotonic() / self.pace

    def wait_until(self, moment: float) -> None:
        """Sleeps until ``moment`` s."""
        left = moment - self()
        if left > 0.0:
            time.sleep(left * self.pace)
