"""The simulated robot's camera: its settings, and its frames in shared memory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph_franka.perception.camera import CameraFrame, Intrinsics, pose
from contactgraph_franka.shared_ring import RingReader, RingWriter

_SLOTS = 4  # A reader has three frames' time to copy one


@dataclass(frozen=True)
class CameraSettings:
    """A camera on a stand opposite the arm, with the lens and pixels of a RealSense D435."""

    intrinsics: Intrinsics = Intrinsics(1386.0, 1386.0, 959.5, 539.5, 1920, 1080)  # noqa: RUF009
    eye: tuple[float, ...] = (1.3, 0.0, 0.4)
    """m, in the frame of the arm's base. From higher up the hand hides the block before it grasps
    it (0.4 s in one sweep of fourteen from 0.55 m); from lower, a grasped block shows a single tag,
    whose tilt is uncertain (1 cm of error, and more)."""
    look_at: tuple[float, ...] = (0.45, 0.0, 0.15)
    """m: the point in the middle of the frame."""
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
        """[4, 4]: that of an upright camera, in the frame of the arm's base."""
        forward = np.subtract(self.look_at, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        return pose(np.stack([right, down, forward], axis=1), np.array(self.eye))

    @staticmethod
    def from_dict(fields: dict[str, Any]) -> "CameraSettings":
        """The settings of `dataclasses.asdict`, also from JSON."""
        points = {name: tuple(fields[name]) for name in ("eye", "look_at")}
        lens = Intrinsics(**fields["intrinsics"])
        return CameraSettings(**{**fields, **points, "intrinsics": lens})


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
