"""How well a rehearsal's server keeps time, counted in memory that other processes read."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from contactgraph_franka.sim.shared_array import create_shared, open_shared

_COUNTERS = np.dtype(
    {
        "names": ["places", "ready", "ticks", "late", "dropped", "began", "now", "busy", "latest"],
        "formats": ["i8"] * 5 + ["f8"] * 4,
    }
)
_LATE = 0.5
"""Of a tick: begun later than this, it counts as late."""


@dataclass(frozen=True)
class ServerReport:
    """How well the server kept time, since its start."""

    ticks: int
    late: int
    """Ticks begun more than half a tick late."""
    dropped: int
    """Ticks that never were, since the server was too far behind."""
    rate: float
    """Ticks a second on the wall; 1000 / pace is on time."""
    busy: float
    """Share of the time in which it worked."""
    latest: float
    """s, on the wall: the latest that a tick began."""


class ServerCounters:
    """The server's end. ``places`` is the length of MuJoCo's ``qpos``."""

    def __init__(self, folder: Path, places: int, period: float) -> None:
        self._shared = create_shared(folder / "counters", _COUNTERS, 1)
        self._shared["places"] = places
        self._late_after = _LATE * period

    def start(self, now: float) -> None:
        """From ``now`` s on, the server serves."""
        self._shared["began"] = self._shared["now"] = now
        self._shared["ready"] = 1

    def count(self, ticks: int, now: float, worked: float, behind: float) -> None:
        """After a tick that began ``behind`` s late and took ``worked`` s."""
        shared = self._shared
        shared["ticks"], shared["now"] = ticks, now
        shared["busy"] += worked
        if behind > self._late_after:
            shared["late"] += 1
            shared["latest"] = max(shared["latest"][0], behind)

    def drop(self, ticks: int) -> None:
        """That so many ticks were left out."""
        self._shared["dropped"] += ticks


def read_report(folder: Path) -> ServerReport | None:
    """The report of the server of ``folder``; None before it is ready."""
    path = folder / "counters"
    if not path.exists() or path.stat().st_size < _COUNTERS.itemsize:
        return None
    counters = open_shared(path, _COUNTERS)[0]
    if not counters["ready"]:
        return None
    span = max(float(counters["now"] - counters["began"]), 1e-9)
    return ServerReport(
        ticks=int(counters["ticks"]),
        late=int(counters["late"]),
        dropped=int(counters["dropped"]),
        rate=float(counters["ticks"]) / span,
        busy=float(counters["busy"]) / span,
        latest=float(counters["latest"]),
    )


def read_places(folder: Path) -> int:
    """How many numbers MuJoCo's ``qpos`` has; the server must be ready."""
    return int(open_shared(folder / "counters", _COUNTERS)["places"][0])
