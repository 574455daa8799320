"""Rings of records in memory that several processes map, without locks.

The processors that the arm's library supports keep the order of writes.
"""

import tempfile
from pathlib import Path

import numpy as np
from numpy.lib.format import open_memmap

MEMORY = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
"""Parent of the folders of shared files: in memory, if the system has it."""
MARGIN = 64
"""Oldest records that may be overwritten while they are read."""
_COUNT = np.dtype("i8")


def create_shared(path: Path, dtype: np.dtype, count: int) -> np.ndarray:
    """[count] zeros in a file that several processes map."""
    return np.asarray(open_memmap(path, "w+", dtype, (count,)))


def open_shared(path: Path, mode: str = "r") -> np.ndarray:
    """The array of `create_shared`, without copying; ``mode`` "r+" to write."""
    return np.asarray(open_memmap(path, mode))


class RingWriter:
    """The writing end of a ring of ``slots`` records with the given ``fields``."""

    def __init__(self, path: Path, fields: list[tuple], slots: int) -> None:
        # The two numbers of a record differ while it is written.
        dtype = np.dtype([("number", "i8"), *fields, ("again", "i8")])
        self._slots = create_shared(path, dtype, slots)
        self._slots["number"] = self._slots["again"] = -1
        self._count = create_shared(path.with_suffix(".count"), _COUNT, 1)
        self._number = -1

    def begin(self) -> np.void:
        """The next record, to be filled and then published."""
        self._number += 1
        self._slot = self._slots[self._number % len(self._slots)]
        self._slot["number"] = self._number
        return self._slot

    def publish(self) -> None:
        """Shows the record to readers."""
        self._slot["again"] = self._number
        self._count[0] = self._number + 1


class RingReader:
    """The reading end of `RingWriter`, in any process."""

    def __init__(self, path: Path) -> None:
        self._slots = open_shared(path)
        self._count = open_shared(path.with_suffix(".count"))

    @property
    def count(self) -> int:
        """Number of published records."""
        return int(self._count[0])

    def newest(self) -> np.void:
        """A copy of the newest record; there must be one."""
        while True:
            number = self.count - 1
            record = self._slots[number % len(self._slots)].copy()
            if record["number"] == record["again"] == number:
                return record

    def last(self, first: int) -> np.ndarray:
        """[K]: the complete records from number ``first`` on that are still kept, in order."""
        wanted = np.arange(max(first, self.count - len(self._slots) + MARGIN, 0), self.count)
        records = self._slots[wanted % len(self._slots)]
        return records[(records["number"] == wanted) & (records["again"] == wanted)]
