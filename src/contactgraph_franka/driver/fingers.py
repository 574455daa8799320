"""Whether fingers hold something, from their width alone."""

import math
from collections import deque

import numpy as np

FALSE_ALARM = 0.02
"""How often fingers that close on nothing seem to be stopped (see `docs/real-arm.md`)."""
MISS = 0.05
"""How often fingers that are stopped seem not to be."""
DELAY = 0.05
"""s, at most, from the touch to when it is told."""
_WINDOW = 0.03
"""s over which the fingers' motion is measured."""
_MOVED = 0.003
"""m that the fingers must have come before anything can have stopped them."""
_STOPPED = 0.01
"""m/s: fingers that close at a tenth of their speed are stopped."""
_EMPTY = 0.005
"""m: fingers this close to each other hold nothing that is meant to be held."""


class FingerContact:
    """Fingers that close, and stop before they meet, have something between them.

    A weak sensor: it says something only from when the fingers close, and what it says comes late.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, float]] = deque()
        self.reset()

    def reset(self) -> None:
        """Nothing is known."""
        self.value = math.nan
        """1: something is between the fingers. 0: nothing is. NaN: it cannot be told."""
        self._past.clear()
        self._begun: float | None = None

    def step(self, width: float, now: float, closing: bool) -> None:
        """The fingers are ``width`` m apart at ``now`` s; ``closing``: that is what they are to."""
        if not closing:
            self.reset()
            return
        if self._begun is None:
            self._begun = width
        self._past.append((now, width))
        while now - self._past[0][0] > _WINDOW and now - self._past[1][0] >= _WINDOW:
            self._past.popleft()
        began, before = self._past[0]
        if width < _EMPTY:
            self.value = 0.0
        elif self._begun - width > _MOVED and now - began >= _WINDOW:
            self.value = float(before - width < _STOPPED * (now - began))
        else:
            self.value = math.nan


OPEN_WIDTH = 0.06
"""m, between the fingers while there is nothing to grasp: as they go in the simulated task."""
_BLOCK = 0.04
"""m, the width of a block."""
_CLOSING = 0.11
"""m/s, of the width: what fingers do that are told 0.1, as the rehearsal's are."""
LAG = 0.005
"""s, from the decision to when the fingers move, as the rehearsal's do."""
_PAST = 0.012
"""m: how far the grasp point has passed a block's centre when the fingers meet on it. Before it,
they would be too narrow as they come to the block: a hand on a curved way is off by some
millimetres, and a finger that hits the block's front pushes it away. Later, they would hold it
where a model does not know that they can."""
_AT = 0.012
"""m: nearer than this, a hand that rests is at the block."""
_RESTS = 0.03
"""m/s"""
_MISS = 0.022
"""m: a block that passes farther from the grasp point is not grasped."""
_SLACK = 0.003
"""m: fingers that are wider apart have not met the block yet."""
_LOST = 0.06
"""m: a block that is farther away is not between the fingers, however late it is seen."""
_EMPTY_grasp_reflex = 0.005
"""m: fingers this close to each other hold nothing."""


class GraspTrigger:
    """Decides whether the fingers are to be open or closed.

    They close as long before they are to meet on a block as they need for the way, hold what they
    meet, and open again where they met nothing or the block is seen elsewhere.
    """

    def __init__(self, lag: float = LAG) -> None:
        """``lag`` s from the decision to when the fingers move."""
        self._lag = lag
        self.closed = False
        """Whether the fingers are to be closed."""
        self.block = 0
        """The block that they close on, or closed on last."""

    def release(self) -> None:
        """The fingers are to open."""
        self.closed = False

    def step(
        self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray, width: float
    ) -> bool:
        """Whether the fingers, now ``width`` m apart, are to be closed.

        ``offset`` [M, 3] m from the grasp point to the blocks; ``velocity`` [M, 3] m/s of the grasp
        point against them; ``tracked`` [M] bool: those that are not are let be.
        """
        if self.closed:
            self.closed = width > _EMPTY_grasp_reflex and not self._gone(offset, tracked, width)
            return self.closed
        in_time = self._lag + max(width - _BLOCK, 0.0) / _CLOSING
        for block, seen in enumerate(tracked.tolist()):
            if seen and _time_to(offset[block].tolist(), velocity[block].tolist()) <= in_time:
                self.closed, self.block = True, block
        return self.closed

    def _gone(self, offset: np.ndarray, tracked: np.ndarray, width: float) -> bool:
        if width > _BLOCK + _SLACK or not tracked[self.block]:
            return False
        return math.hypot(*offset[self.block].tolist()) > _LOST


def _time_to(offset: list[float], velocity: list[float]) -> float:
    """s until the fingers are to meet on a block; infinity where the grasp point passes it too far
    off or moves away. May be negative: then it is late."""
    # Plain numbers: at a kilohertz, arrays of three take longer than what they are asked.
    (x, y, z), (u, v, w) = offset, velocity
    square = x * x + y * y + z * z
    speed_square = u * u + v * v + w * w
    if speed_square <= _RESTS**2:
        return 0.0 if square <= _AT**2 else math.inf
    closing = x * u + y * v + z * w
    speed = math.sqrt(speed_square)
    if closing < -_PAST * speed:
        return math.inf
    if square - closing * closing / speed_square > _MISS**2:
        return math.inf
    return closing / speed_square + _PAST / speed
