"""Parts of a frame."""

from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.camera import Intrinsics

_HALF_BODY = 0.075
"""m: all of a block is within this distance of its centre, seen from wherever."""
_STEP = 64
"""px: widths are multiples of it, so that few different ones come up."""


@dataclass(frozen=True)
class Window:
    """Columns from ``left`` on and rows from ``top`` on, px."""

    left: int
    top: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Of the frame."""
        return slice(self.top, self.top + self.height)

    @property
    def columns(self) -> slice:
        """Of the frame."""
        return slice(self.left, self.left + self.width)


def whole(lens: Intrinsics) -> Window:
    """All of it."""
    return Window(0, 0, lens.width, lens.height)


def window_around(point: np.ndarray, pose: np.ndarray, lens: Intrinsics) -> Window | None:
    """A square about a body at ``point`` [3] m, moved into the frame; None where it is not in view.

    ``pose`` [4, 4] is the camera's.
    """
    x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
    if z <= _HALF_BODY:
        return None
    half = max(lens.fx, lens.fy) * _HALF_BODY / (z - _HALF_BODY)
    column, row = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    if not (-half < column < lens.width + half and -half < row < lens.height + half):
        return None
    side = min(_STEP * int(np.ceil(2.0 * half / _STEP)), lens.width, lens.height)
    left = int(np.clip(round(column - side / 2.0), 0, lens.width - side))
    top = int(np.clip(round(row - side / 2.0), 0, lens.height - side))
    return Window(left, top, side, side)
