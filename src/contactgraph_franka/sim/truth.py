"""What is really so in a rehearsal, tick by tick, in memory that other processes read."""

from pathlib import Path

import numpy as np

from contactgraph_franka.sim.shared_array import create_shared, open_shared

_KEPT = 1 << 15
"""Ticks that are kept: 32 simulated seconds, so that a run can be read when it is over."""
_MARGIN = 64
"""Ticks before the oldest one that may be overwritten while they are read."""


def truth_type(blocks: int, places: int) -> np.dtype:
    """The fields of a tick, for ``blocks`` blocks and a ``qpos`` of ``places`` numbers.

    Nodes are the hand's grasp point and the blocks. Positions in the frame of the arm's base.
    """
    return np.dtype(
        [
            ("tick", "i8"),
            ("time", "f8"),  # s, simulated since the start
            ("stamp", "f8"),  # s, on the reader's clock
            ("position", "f8", (1 + blocks, 3)),  # m
            ("velocity", "f8", (1 + blocks, 3)),  # m/s
            ("turn", "f8", (1 + blocks, 4)),  # unit quaternions, the real part first
            ("fingers", "?", (blocks, 2)),  # whether the left, the right finger touches
            ("standing", "?", (blocks,)),  # whether it touches the table
            ("width", "f8"),  # m between the fingers
            ("places", "f8", (places,)),  # MuJoCo's qpos, for a renderer
            ("again", "i8"),  # the tick once more: one that is being written has two
        ]
    )


class TruthWriter:
    """Writes a tick at a time. ``row`` is filled by the caller, then `publish` shows it."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        kind = truth_type(blocks, places)
        self._rows = create_shared(folder / "truth", kind, _KEPT)
        self._rows["tick"] = self._rows["again"] = -1
        self._newest = create_shared(folder / "newest", np.dtype("i8"), 1)
        self._newest[0] = -1
        self.row = np.zeros(1, kind)

    def publish(self, tick: int) -> None:
        """Shows ``row`` as that of ``tick``, which count from 0."""
        self.row["tick"] = self.row["again"] = tick
        # In this order, which the processors that an arm's library runs on keep.
        self._rows[tick % _KEPT : tick % _KEPT + 1] = self.row
        self._newest[0] = tick


class Truth:
    """Reads what `TruthWriter` wrote, from any process."""

    def __init__(self, folder: Path, blocks: int, places: int) -> None:
        self._rows = open_shared(folder / "truth", truth_type(blocks, places))
        self._newest = open_shared(folder / "newest", np.dtype("i8"))

    def newest(self) -> np.void:
        """The newest tick, with the fields of `truth_type`."""
        while True:
            tick = int(self._newest[0])
            row = self._rows[tick % _KEPT].copy()
            if row["tick"] == row["again"] == tick:
                return row

    def since(self, tick: int) -> np.ndarray:
        """[K]: the ticks after ``tick`` that are still kept, in order."""
        newest = int(self._newest[0])
        first = max(tick + 1, newest + 1 - _KEPT + _MARGIN, 0)
        rows = self._rows[np.arange(first, newest + 1) % _KEPT]
        whole = (rows["tick"] == np.arange(first, newest + 1)) & (rows["again"] == rows["tick"])
        return rows[whole]

    def between(self, begin: float, end: float) -> np.ndarray:
        """[K]: the kept ticks with stamps from ``begin`` to ``end`` s on the reader's clock."""
        rows = self.since(-1)
        return rows[(rows["stamp"] >= begin) & (rows["stamp"] <= end)]
