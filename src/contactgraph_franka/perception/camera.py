"""Rigid motions as 4x4 matrices: ``pose_base_camera`` takes points of the camera to the base."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from contactgraph.data import InvalidInputError


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """[4, 4] from a rotation matrix [3, 3] and a position [3] m."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, position
    return made


def inverse(motion: np.ndarray) -> np.ndarray:
    """[4, 4], the way back."""
    back = motion[:3, :3].T
    return pose(back, -back @ motion[:3, 3])


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """[3, 3]: by ``|vector|`` rad about ``vector`` [3] (Rodrigues' formula)."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    one = math.sin(angle) / angle
    two = (1.0 - math.cos(angle)) / angle**2
    return np.eye(3) + one * cross + two * cross @ cross


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """[3] rad, of length 0 to pi: what `rotation_of` turns into ``rotation`` [3, 3]."""
    # The largest part of the unit quaternion first: no half turn is near a division by zero.
    diagonal = np.diag(rotation)
    squares = np.array([1.0 + diagonal.sum(), *(1.0 + 2.0 * diagonal - diagonal.sum())])
    largest = int(np.argmax(squares))
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    quaternion = np.empty(4)
    quaternion[largest] = squares[largest]
    if largest == 0:
        quaternion[1:] = skew
    else:
        axis = largest - 1
        quaternion[1:] = rotation[axis] + rotation[:, axis]
        quaternion[largest] = squares[largest]
        quaternion[0] = skew[axis]
    quaternion /= np.linalg.norm(quaternion)
    if quaternion[0] < 0.0:
        quaternion = -quaternion
    length = float(np.linalg.norm(quaternion[1:]))
    if length < 1e-12:
        return 2.0 * quaternion[1:]
    return quaternion[1:] * (2.0 * math.atan2(length, quaternion[0]) / length)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3]: the rotation nearest to a matrix in the sense of least squares."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


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


_KEPT = 300
"""Frames, ten seconds at 30 Hz: a device's clock drifts by a millisecond in minutes."""


class FrameClock:
    """Maps times of a camera to ``clock``, which need not be the system's."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._ways: deque[float] = deque(maxlen=_KEPT)

    def from_epoch(self, moment: float) -> float:
        """s, of a time since 1970 that the system's clock tells as well."""
        return self._clock() - (time.time() - moment)

    def from_device(self, moment: float) -> float:
        """s, of a time on the device's own clock, at the arrival of the frame it belongs to.

        The two clocks' difference is that of the frame that came quickest of the last 300. What
        even that one needed to come is not seen: times are late by so much, some milliseconds.
        """
        self._ways.append(self._clock() - moment)
        return moment + min(self._ways)
