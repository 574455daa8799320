"""What a camera is, and how it maps points to pixels."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from contactgraph.data import InvalidInputError

_UNDISTORT_STEPS = 8
"""Fixed-point steps: lenses of depth cameras bend so little that five give 1e-9."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: x to the right, y down, z forward; pixel centres at whole numbers.

    Raises `InvalidInputError` for what no camera has.
    """

    fx: float
    """px"""
    fy: float
    """px"""
    cx: float
    """px: the column where the optical axis passes."""
    cy: float
    """px"""
    width: int
    """px"""
    height: int
    """px"""
    distortion: tuple[float, ...] | None = None
    """Brown and Conrady's (k1, k2, p1, p2, k3), as OpenCV orders them; None: a straight lens."""

    def __post_init__(self) -> None:
        for name, least in (("fx", 1.0), ("fy", 1.0), ("width", 16), ("height", 16)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= least):
                raise InvalidInputError(f"{name} must be at least {least} px, found {value}")
        if not np.isfinite([self.cx, self.cy]).all():
            raise InvalidInputError(f"cx, cy must be finite px, found {self.cx}, {self.cy}")
        if self.distortion is not None and (
            len(self.distortion) != 5 or not np.isfinite(self.distortion).all()
        ):
            raise InvalidInputError(
                f"distortion must be 5 finite numbers (k1, k2, p1, p2, k3), found {self.distortion}"
            )

    def project(self, points: np.ndarray) -> np.ndarray:
        """[..., 2] px of points [..., 3] m in the camera's frame, all in front of it."""
        plane = points[..., :2] / points[..., 2:]
        if self.distortion is not None:
            plane = _distorted(plane, self.distortion)
        return plane * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """[..., 2]: x/z and y/z of what is seen at ``pixels`` [..., 2] px, undistorted."""
        seen = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion is None:
            return seen
        plane = seen
        for _ in range(_UNDISTORT_STEPS):
            plane = plane + seen - _distorted(plane, self.distortion)
        return plane


def _distorted(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane[..., 0], plane[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One picture, and when it was taken."""

    image: np.ndarray
    """[H, W] uint8, grey."""
    depth: np.ndarray | None
    """[H, W] float32 m along the optical axis, pixel by pixel with ``image``; 0 where not known."""
    time: float
    """s, on the reader's clock: the middle of the exposure, not when the frame arrived."""


class Camera(Protocol):
    """A source of frames, all with the same intrinsics."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Of ``image`` and ``depth`` alike."""

    def read(self) -> CameraFrame | None:
        """The newest frame; None where none has come since the last call. Never waits for one."""

    def close(self) -> None:
        """Gives the device back. No `read` after it."""
