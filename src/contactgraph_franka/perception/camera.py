"""Cameras: rigid motions, projection, frames and their time stamps.

A pose is a 4x4 matrix; the camera's pose takes points of the camera's frame to the base's.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError

_UNDISTORT_STEPS = 8  # Fixed-point iterations; lenses of depth cameras converge to 1e-9 in five
AHEAD = 0.1
"""s, by which a stamp may be ahead of the clock, and its offset differ from the last one."""
_AGREE = 3
"""Frames in a row of another offset, from which on that is the clock's."""
_OFFSETS = 300
"""Frames whose clock offsets are kept, ten seconds at 30 Hz; clocks drift by 1 ms in minutes."""
_ORTHOGONALITY = 1e-4  # Largest deviation of a stored matrix from a rotation


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """[4, 4] from a rotation matrix [3, 3] and a position [3] m."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def transform(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[..., 3] m: ``points`` moved by a pose."""
    return points @ motion[:3, :3].T + motion[:3, 3]


def perturbed(motion: np.ndarray, step: np.ndarray) -> np.ndarray:
    """[4, 4]: a pose turned by ``step[:3]`` rad about its origin and moved by ``step[3:]`` m."""
    return pose(rotation_of(step[:3]) @ motion[:3, :3], motion[:3, 3] + step[3:])


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """[3, 3]: the rotation by ``|vector|`` rad about ``vector`` [3]."""
    return Rotation.from_rotvec(vector).as_matrix()


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3]: the rotation nearest to a matrix in the Frobenius norm."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def check_pose(name: str, matrix: np.ndarray) -> None:
    """Raises `InvalidInputError` unless ``matrix`` is a rigid motion [4, 4]."""
    if np.shape(matrix) != (4, 4) or not np.isfinite(matrix).all():
        raise InvalidInputError(f"{name} must be [4, 4] finite numbers, found {np.shape(matrix)}")
    turn = matrix[:3, :3]
    orthogonal = np.abs(turn @ turn.T - np.eye(3)).max() < _ORTHOGONALITY
    rigid = orthogonal and np.linalg.det(turn) > 0.0
    if not rigid or not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise InvalidInputError(f"{name} must be a rotation and a position over (0, 0, 0, 1)")


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: x right, y down, z forward; pixel centres at integers.

    Raises `InvalidInputError` for values that no camera has.
    """

    fx: float
    """px"""
    fy: float
    """px"""
    cx: float
    """px: column of the optical axis."""
    cy: float
    """px: row of the optical axis."""
    width: int
    """px"""
    height: int
    """px"""
    distortion: tuple[float, ...] | None = None
    """Brown-Conrady coefficients (k1, k2, p1, p2, k3) in OpenCV's order; None: no distortion."""

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
        """[..., 2]: undistorted x/z and y/z of ``pixels`` [..., 2] px."""
        distorted = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion is None:
            return distorted
        plane = distorted
        for _ in range(_UNDISTORT_STEPS):
            plane = plane + distorted - _distorted(plane, self.distortion)
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


@dataclass(frozen=True)
class Window:
    """A part of a frame, px."""

    left: int
    top: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Rows of the frame."""
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        """Columns of the frame."""
        return slice(self.left, self.left + self.width)


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One picture."""

    image: np.ndarray
    """[H, W] uint8, grey."""
    depth: np.ndarray | None
    """[H, W] float32 m along the optical axis, registered to ``image``; 0: unknown."""
    time: float
    """s, on the reader's clock: the middle of the exposure."""


class Camera(Protocol):
    """A source of frames with constant intrinsics."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of ``image`` and ``depth``."""

    def read(self) -> CameraFrame | None:
        """The newest frame, without waiting; None if there is none since the last call."""

    def close(self) -> None:
        """Releases the device."""


class FrameClock:
    """Maps times of a camera to ``clock``, which need not be the system's.

    NaN where a frame would be more than 0.1 s ahead of the clock: its stamp is wrong.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._offsets: deque[float] = deque(maxlen=_OFFSETS)
        self._others: list[float] = []
        """The last offsets in a row that are far from those before."""

    def from_epoch(self, moment: float) -> float:
        """s, from seconds since 1970 on the system's clock."""
        return self._not_ahead(self._clock() - (time.time() - moment))

    def from_device(self, moment: float) -> float:
        """s, from the device's clock, to be called at the arrival of the frame.

        The offset is that of the fastest of the last 300 frames, so that times are late by the
        least transfer time, some milliseconds. Three frames in a row whose offsets are far from
        those before take their place, since the device's clock was set.
        """
        offset = self._clock() - moment
        near = not self._offsets or abs(offset - self._offsets[-1]) <= AHEAD
        self._others = [] if near else [*self._others, offset]
        if len(self._others) == _AGREE:
            self._offsets, self._others = deque(self._others, _OFFSETS), []
        elif near:
            self._offsets.append(offset)
        else:
            return math.nan
        return self._not_ahead(moment + min(self._offsets))

    def _not_ahead(self, moment: float) -> float:
        return moment if moment <= self._clock() + AHEAD else math.nan
