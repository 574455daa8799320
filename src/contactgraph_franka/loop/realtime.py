"""The one clock that readings, commands and the loop share."""

import gc
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
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


_SWITCH_S = 1e-4
"""After so long a thread that computes in Python lets one in that waits: five milliseconds, if
nobody says otherwise, would be five ticks."""
_PRIORITY = 50
"""Of 1 to 99; those of the system's own threads are above."""


@contextmanager
def realtime_priority() -> Iterator[None]:
    """No collection of garbage within, which can take 100 ms; other threads give way sooner.

    Where the system lets it (root, or a limit ``rtprio`` in ``/etc/security/limits.conf``), all
    threads of this process have real-time priority within: on a machine that is busy with other
    things, ticks come 0.1 ms late (99 %) with it, and 4 ms without. All, because one that waits
    for a core while it holds Python's lock holds up those that have one.
    """
    collecting, interval = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH_S)
    raised = _raised()
    try:
        yield
    finally:
        for thread in raised:
            with suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(interval)
        if collecting:
            gc.enable()


def _raised() -> list[int]:
    """Gives usual threads of this process real-time priority; which of them have it now."""
    tasks = Path("/proc/self/task")
    raised = []
    for thread in [int(task.name) for task in tasks.iterdir()] if tasks.is_dir() else []:
        # One may have ended meanwhile, or the system may not let it.
        with suppress(OSError):
            if os.sched_getscheduler(thread) == os.SCHED_OTHER:
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(_PRIORITY))
                raised.append(thread)
    return raised


def set_nice(nice: int) -> None:
    """Makes this process yield to others, by ``nice`` of 0 to 19.

    One that was begun by a thread with real-time priority would have that priority, too: a camera
    that draws without pause would then stop all else on its core.
    """
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(nice)
