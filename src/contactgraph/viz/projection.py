"""Projection of a scene to its picture: 2D from above, 3D from the side."""

from dataclasses import dataclass

import numpy as np

_AZIMUTH, _ELEVATION = np.radians(-60.0), np.radians(25.0)
"""Viewing direction of a scene in space: from the right and front, raised."""


@dataclass(frozen=True, eq=False)
class Projection:
    """An orthographic view: scale does not depend on depth.

    Takes points of ``D`` degrees of freedom, of which the first three are drawn; two lie in the
    plane, at height 0. A ball is drawn as a circle of its own radius.
    """

    axes: np.ndarray
    """[3, 3] unit vectors in the scene: the picture's right, its up, and towards the eye."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """[..., 2] m in the picture of ``points`` [..., D] m."""
        return _in_space(points) @ self.axes[:2].T

    def depth(self, points: np.ndarray) -> np.ndarray:
        """[...] m: nearness of ``points`` [..., D] m to the viewer."""
        return _in_space(points) @ self.axes[2]

    def half_extent(self, size: np.ndarray) -> np.ndarray:
        """[..., 2] m: half the extent in the picture of a box of sides ``size`` [..., D] m."""
        return 0.5 * _in_space(size) @ np.abs(self.axes[:2]).T

    def box_faces(self, middle: np.ndarray, size: np.ndarray) -> list[np.ndarray]:
        """[4, 2] m each: the outlines of the faces of a box that are turned to the eye.

        ``middle`` [D] m; ``size`` [D] m, its sides along the axes. In the plane, one rectangle.
        """
        middle, half = _in_space(middle), np.diag(0.5 * _in_space(size))
        faces = []
        for axis in range(3):
            if abs(self.axes[2, axis]) < 1e-9:
                continue
            first, second = half[(axis + 1) % 3], half[(axis + 2) % 3]
            centre = middle + np.sign(self.axes[2, axis]) * half[axis]
            corners = (first + second, first - second, -first - second, -first + second)
            faces.append(self(centre + np.stack(corners)))
        return faces


def _in_space(points: np.ndarray) -> np.ndarray:
    """[..., 3]: the first three degrees of freedom, zero where missing."""
    points = np.asarray(points)[..., :3]
    return np.pad(points, [(0, 0)] * (points.ndim - 1) + [(0, 3 - points.shape[-1])])


def _from_aside(azimuth: float, elevation: float) -> np.ndarray:
    east, north = np.cos(azimuth), np.sin(azimuth)
    level, raised = np.cos(elevation), np.sin(elevation)
    return np.array(
        [
            [-north, east, 0.0],
            [-raised * east, -raised * north, level],
            [level * east, level * north, raised],
        ]
    )


_FROM_ABOVE = Projection(np.eye(3))
_FROM_ASIDE = Projection(_from_aside(_AZIMUTH, _ELEVATION))


def projection_of(dimension: int) -> Projection:
    """The view of a scene with ``dimension`` degrees of freedom per node."""
    return _FROM_ASIDE if dimension >= 3 else _FROM_ABOVE
