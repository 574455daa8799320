"""Camera frames in memory that other processes read."""

from pathlib import Path

import numpy as np

from contactgraph_franka.perception.camera import CameraFrame, Intrinsics
from contactgraph_franka.sim.shared_array import create_shared, open_shared

_SLOTS = 4
"""A reader has three frames' time to copy one."""


def _frame_type(lens: Intrinsics, depth: bool) -> np.dtype:
    shape = (lens.height, lens.width)
    parts: list[tuple] = [("number", "i8"), ("time", "f8"), ("image", "u1", shape)]
    if depth:
        parts.append(("depth", "f4", shape))
    return np.dtype([*parts, ("again", "i8")])


class FrameWriter:
    """The camera's end. ``missed`` frames are counted by the caller."""

    def __init__(self, folder: Path, lens: Intrinsics, depth: bool) -> None:
        self._slots = create_shared(folder / "frames", _frame_type(lens, depth), _SLOTS)
        self._slots["number"] = self._slots["again"] = -1
        self._number = -1
        self._newest = create_shared(folder / "newest-frame", np.dtype("i8"), 2)
        self._newest[:] = -1, 0

    def publish(self, frame: CameraFrame) -> None:
        """Shows a frame to readers."""
        self._number += 1
        slot = self._slots[self._number % _SLOTS]
        slot["number"] = self._number
        slot["time"], slot["image"] = frame.time, frame.image
        if frame.depth is not None:
            slot["depth"] = frame.depth
        slot["again"] = self._number
        self._newest[0] = self._number

    def miss(self, frames: int) -> None:
        """Counts frames that were never taken, since the one before was still being drawn."""
        self._newest[1] += frames


class RehearsalCamera:
    """The camera of a rehearsal, as whoever stands before its screen has it: a `Camera`."""

    def __init__(self, folder: Path, lens: Intrinsics, depth: bool) -> None:
        self._lens = lens
        self._has_depth = depth
        self._slots = open_shared(folder / "frames", _frame_type(lens, depth))
        self._newest = open_shared(folder / "newest-frame", np.dtype("i8"))
        self._seen = -1

    @property
    def intrinsics(self) -> Intrinsics:
        """Of all frames."""
        return self._lens

    @property
    def missed(self) -> int:
        """Frames that were never taken, since the one before was still being drawn."""
        return int(self._newest[1])

    def read(self) -> CameraFrame | None:
        """The newest frame; None where none has come since the last call."""
        while True:
            number = int(self._newest[0])
            if number == self._seen:
                return None
            slot = self._slots[number % _SLOTS]
            image, time = slot["image"].copy(), float(slot["time"])
            depth = slot["depth"].copy() if self._has_depth else None
            # One that was written over meanwhile has another number, or two.
            if slot["number"] == slot["again"] == number:
                self._seen = number
                return CameraFrame(image, depth, time)

    def close(self) -> None:
        """Nothing is held that must be given back."""
