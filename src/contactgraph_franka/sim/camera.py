"""The simulated robot's camera: its settings, and its frames in shared memory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, pose
from contactgraph_franka.shared_ring import RingReader, RingWriter

_EYE = np.array([1.3, 0.0, 0.4])
_LOOK_AT = np.array([0.45, 0.0, 0.15])
"""m, in the frame of the arm's base. From higher up the hand hides the block before it grasps it
(0.4 s in one sweep of fourteen from 0.55 m); from lower, a grasped block shows a single tag, whose
tilt is uncertain (1 cm of error, and more)."""
_SLOTS = 4  # A reader has three frames' time to copy one


def look_at(eye: np.ndarray, point: np.ndarray) -> np.ndarray:
    """[4, 4]: the pose of an upright camera at ``eye`` [3] m towards ``point`` [3] m."""
    forward = (point - eye) / np.linalg.norm(point - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return pose(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


@dataclass(frozen=True)
class CameraSettings:
    """A camera on a stand opposite the arm, with the lens and pixels of a RealSense D435."""

    intrinsics: Intrinsics = Intrinsics(1386.0, 1386.0, 959.5, 539.5, 1920, 1080)  # noqa: RUF009
    place: tuple[tuple[float, ...], ...] = tuple(
        tuple(row) for row in look_at(_EYE, _LOOK_AT).tolist()
    )
    """[4, 4]: its pose in the frame of the arm's base."""
    rate: float = 30.0
    """Frames a simulated second."""
    delay: float = 0.03
    """s, from exposure to availability."""
    grey_noise: float = 2.0
    """Grey levels, standard deviation."""
    seed: int = 0
    """Seed of the noise."""

    @property
    def pose(self) -> np.ndarray:
        """[4, 4] of `place`."""
        return np.array(self.place)

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "CameraSettings":
        """The settings of `dataclasses.asdict`."""
        lens = dict(fields["intrinsics"])
        if lens["distortion"] is not None:
            lens["distortion"] = tuple(lens["distortion"])
        place = tuple(tuple(row) for row in fields["place"])
        return CameraSettings(**{**fields, "intrinsics": Intrinsics(**lens), "place": place})


def frame_ring(folder: Path, lens: Intrinsics) -> RingWriter:
    """The ring of a camera's frames."""
    fields: list[tuple] = [("time", "f8"), ("image", "u1", (lens.height, lens.width))]
    return RingWriter(folder / "frames", fields, _SLOTS)


def publish_frame(ring: RingWriter, frame: CameraFrame) -> None:
    """Publishes a frame to readers, without its depth."""
    slot = ring.begin()
    slot["time"], slot["image"] = frame.time, frame.image
    ring.publish()


class SimulatedCamera:
    """A `Camera` that reads the frames of another process."""

    def __init__(self, folder: Path, intrinsics: Intrinsics) -> None:
        self.intrinsics = intrinsics
        """Of all frames."""
        self._ring = RingReader(folder / "frames")
        self._read = 0

    def read(self) -> CameraFrame | None:
        """The newest frame; None if there is none since the last call."""
        if self._ring.count == self._read:
            return None
        record = self._ring.newest()
        self._read = int(record["number"]) + 1
        return CameraFrame(record["image"], None, float(record["time"]))

    def close(self) -> None:
        """Does nothing: shared memory needs no release."""
