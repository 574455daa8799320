"""How the camera of a rehearsal is set up."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, pose
from contactgraph_franka.sim.shared_state import create_shared, open_shared

_EYE = np.array([1.3, 0.0, 0.4])
_LOOK_AT = np.array([0.45, 0.0, 0.15])
"""m, in the frame of the arm's base. From higher up the hand hides the block before it grasps it
(0.4 s in one sweep of fourteen from 0.55 m); from lower, a held block shows one tag alone, whose
leaning is uncertain (1 cm of error, and more)."""


def looking_at(eye: np.ndarray, point: np.ndarray) -> np.ndarray:
    """[4, 4]: the pose of a camera at ``eye`` [3] m that looks at ``point`` [3] m, upright."""
    forward = (point - eye) / np.linalg.norm(point - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return pose(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


@dataclass(frozen=True)
class CameraSettings:
    """A camera on a stand opposite the arm; lens and pixels are those of a RealSense D435."""

    intrinsics: Intrinsics = Intrinsics(1386.0, 1386.0, 959.5, 539.5, 1920, 1080)  # noqa: RUF009
    place: tuple[tuple[float, ...], ...] = tuple(
        tuple(row) for row in looking_at(_EYE, _LOOK_AT).tolist()
    )
    """[4, 4]: its pose in the frame of the arm's base."""
    rate: float = 30.0
    """Frames a simulated second."""
    delay: float = 0.03
    """s, from exposure to when a reader can have the frame."""
    grey_noise: float = 2.0
    """Grey levels, standard deviation."""
    depth_noise: float | None = None
    """m at 1 m; None: no depth."""
    seed: int = 0
    """Of the noise."""

    @property
    def pose(self) -> np.ndarray:
        """[4, 4] of `place`."""
        return np.array(self.place)

    @staticmethod
    def from_dict(told: dict[str, Any]) -> "CameraSettings":
        """The settings that `dataclasses.asdict` gave."""
        lens = dict(told["intrinsics"])
        if lens["distortion"] is not None:
            lens["distortion"] = tuple(lens["distortion"])
        place = tuple(tuple(row) for row in told["place"])
        return CameraSettings(**{**told, "intrinsics": Intrinsics(**lens), "place": place})


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


class SimulatedCamera:
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
