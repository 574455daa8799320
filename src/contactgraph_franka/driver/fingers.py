"""Decisions about the fingers: when to close on a passing block, and whether they hold it."""

import math
from collections import deque

import numpy as np

OPEN_WIDTH = 0.06
"""m, between the open fingers, as in the simulated task."""
LAG = 0.005
"""s, from the decision to the motion of the fingers, for the simulated robot."""
FALSE_ALARM = 0.02
"""Rate at which fingers that close on nothing are reported to be stopped (`docs/real-arm.md`)."""
MISS = 0.05
"""Rate at which stopped fingers are not reported."""
DELAY = 0.05
"""s, at most, from contact to its report."""
_BLOCK = 0.04
"""m, the width of a block."""
_CLOSING = 0.11
"""m/s, rate of the width for a command of 0.1, as of the simulated robot."""
_PAST = 0.012
"""m: distance of the grasp point past a block's centre when the fingers meet on the block. Earlier,
they would be too narrow on arrival: a hand on a curved path is off by some millimetres, and a
finger that hits the block's front pushes it away. Later, they would hold it where a model does not
know that they can."""
_AT = 0.012
"""m: a hand at rest is at the block below this distance."""
_RESTS = 0.03
"""m/s"""
_MISS_DISTANCE = 0.022
"""m: a block that passes farther from the grasp point is not grasped."""
_SLACK = 0.003
"""m: fingers that are wider apart have not met the block yet."""
_LOST = 0.06
"""m: a block farther away is not between the fingers, even with a late measurement."""
_EMPTY = 0.005
"""m: fingers closer to each other hold nothing."""
_WINDOW = 0.03
"""s over which the fingers' motion is measured."""
_MOVED = 0.003
"""m that the fingers must have moved before anything can have stopped them."""
_STOPPED = 0.01
"""m/s: fingers that close at a tenth of their speed are stopped."""


class FingerContact:
    """A contact sensor: fingers that close, and stop before they meet, hold something.

    It is weak: it measures only while the fingers close, and reports late.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, float]] = deque()
        self.reset()

    def reset(self) -> None:
        """Forgets all measurements."""
        self.value = math.nan
        """1: something is between the fingers. 0: nothing is. NaN: unknown."""
        self._past.clear()
        self._first_width: float | None = None

    def step(self, width: float, now: float, closing: bool) -> None:
        """Takes in the ``width`` m at ``now`` s; ``closing``: whether the fingers are to close."""
        if not closing:
            self.reset()
            return
        if self._first_width is None:
            self._first_width = width
        self._past.append((now, width))
        while now - self._past[0][0] > _WINDOW and now - self._past[1][0] >= _WINDOW:
            self._past.popleft()
        time_before, width_before = self._past[0]
        if width < _EMPTY:
            self.value = 0.0
        elif self._first_width - width > _MOVED and now - time_before >= _WINDOW:
            self.value = float(width_before - width < _STOPPED * (now - time_before))
        else:
            self.value = math.nan


class GraspTrigger:
    """Decides whether the fingers are to be open or closed.

    They begin to close early enough to meet on a passing block, hold it, and open again where they
    met nothing or the block is measured elsewhere.
    """

    def __init__(self, lag: float = LAG) -> None:
        """``lag`` s from the decision to the motion of the fingers."""
        self._lag = lag
        self.closed = False
        """Whether the fingers are to be closed."""
        self.block = 0
        """Index of the block that they close on, or closed on last."""

    def release(self) -> None:
        """Opens the fingers."""
        self.closed = False

    def step(
        self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray, width: float
    ) -> bool:
        """Whether the fingers, now ``width`` m apart, are to be closed.

        ``offset`` [M, 3] m from the grasp point to the blocks; ``velocity`` [M, 3] m/s of the grasp
        point relative to them; ``tracked`` [M] bool: untracked blocks are ignored.
        """
        if self.closed:
            self.closed = width > _EMPTY and not self._lost(offset, tracked, width)
            return self.closed
        closing_time = self._lag + max(width - _BLOCK, 0.0) / _CLOSING
        for block, is_tracked in enumerate(tracked.tolist()):
            if not is_tracked:
                continue
            if _time_to_grasp(offset[block].tolist(), velocity[block].tolist()) <= closing_time:
                self.closed, self.block = True, block
        return self.closed

    def _lost(self, offset: np.ndarray, tracked: np.ndarray, width: float) -> bool:
        if width > _BLOCK + _SLACK or not tracked[self.block]:
            return False
        return math.hypot(*offset[self.block].tolist()) > _LOST


def _time_to_grasp(offset: list[float], velocity: list[float]) -> float:
    """s until the fingers are to meet on a block; infinity where the grasp point passes it too far
    off or moves away. Negative where the time has passed."""
    # Plain numbers: at 1 kHz, arrays of three take longer than the arithmetic.
    (x, y, z), (u, v, w) = offset, velocity
    square = x * x + y * y + z * z
    speed_square = u * u + v * v + w * w
    if speed_square <= _RESTS**2:
        return 0.0 if square <= _AT**2 else math.inf
    closing = x * u + y * v + z * w
    speed = math.sqrt(speed_square)
    if closing < -_PAST * speed:
        return math.inf
    if square - closing * closing / speed_square > _MISS_DISTANCE**2:
        return math.inf
    return closing / speed_square + _PAST / speed
