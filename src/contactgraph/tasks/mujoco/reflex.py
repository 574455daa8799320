"""What the fingers do by themselves: they close so that they meet on a block that passes."""

import numpy as np

OPEN = 0.03
"""Way of each finger from the middle while there is nothing to grasp, m."""
HALF_BLOCK = 0.02
"""Half the width of a block, m."""
SPEED = 0.05
"""Of each finger, m/s; the maker's largest."""
REACH = 0.01
"""Distance of the grasp point from a block's centre at which the fingers meet it, m."""
LAG = 0.03
"""Of the fingers behind where they are sent, s."""
LOST = 0.03
"""Fingers that close on a block open again once it is farther away than this, m."""
MISS = 0.022
"""A block that passes farther from the grasp point than this is not grasped, m."""


class GraspReflex:
    """Closes the fingers in time, holds what they hold, and opens them again if it is lost.

    The fingers touch a block as the grasp point comes within 0.015 m of its centre: they begin
    to close as long before as they need at their largest speed.
    """

    def __init__(self) -> None:
        self.way = OPEN
        """Where the fingers are sent, m from the middle."""

    def step(self, offset: np.ndarray, velocity: np.ndarray, held: bool, dt: float) -> float:
        """Where to send each finger, m from the middle.

        ``offset`` [M, 3] m from the grasp point to the blocks; ``velocity`` [M, 3] m/s of the
        grasp point against them; ``held``: whether both fingers touch a block.
        """
        if held:
            self.way = 0.0
            return self.way
        soonest = float(np.min(_time_to(offset, velocity), initial=np.inf)) - LAG
        if self.way <= HALF_BLOCK and np.any(np.sum(offset**2, axis=1) < LOST**2):
            soonest = 0.0
        wanted = 0.0 if soonest <= 0.0 else min(OPEN, HALF_BLOCK + SPEED * soonest)
        self.way = max(wanted, self.way - SPEED * dt)
        self.way = min(self.way, OPEN)
        return self.way


def _time_to(offset: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """[M] s until the grasp point is within `REACH` of each block, or, if it never comes as near,
    nearest to it; 0 where it is, infinity where it passes too far off or moves away."""
    distance_square = np.sum(offset**2, axis=1)
    speed_square = np.maximum(np.sum(velocity**2, axis=1), 1e-12)
    closing = np.sum(offset * velocity, axis=1)
    nearest_square = np.maximum(distance_square - closing**2 / speed_square, 0.0)
    root = np.sqrt(np.maximum(REACH**2 - nearest_square, 0.0) * speed_square)
    time = (closing - root) / speed_square
    passes = (nearest_square > MISS**2) | (closing <= 0.0)
    return np.where(distance_square <= REACH**2, 0.0, np.where(passes, np.inf, time))
