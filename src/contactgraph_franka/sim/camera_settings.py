"""How the camera of a rehearsal is set up."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from contactgraph_franka.perception.camera import Intrinsics
from contactgraph_franka.perception.rigid import pose

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
