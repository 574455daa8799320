"""What the fingers do by themselves: they close so that they meet on a block that passes."""

import math

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

    The fingers touch a block as the grasp point comes within 0.01 m of its centre: they begin
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
        nearest_square, soonest = math.inf, math.inf
        # Plain numbers: at a kilohertz, arrays of three take longer than what they are asked.
        for (x, y, z), (u, v, w) in zip(offset.tolist(), velocity.tolist(), strict=True):
            distance_square = x * x + y * y + z * z
            closing = x * u + y * v + z * w
            nearest_square = min(nearest_square, distance_square)
            soonest = min(soonest, _time_to(distance_square, closing, u * u + v * v + w * w))
        soonest -= LAG
        if self.way <= HALF_BLOCK and nearest_square < LOST**2:
            soonest = 0.0
        wanted = 0.0 if soonest <= 0.0 else min(OPEN, HALF_BLOCK + SPEED * soonest)
        self.way = min(max(wanted, self.way - SPEED * dt), OPEN)
        return self.way


def _time_to(distance_square: float, closing: float, speed_square: float) -> float:
    """s until the grasp point is within `REACH` of a block, or, if it never comes as near, nearest
    to it; 0 where it is, infinity where it passes too far off or moves away.

    ``distance_square`` m^2; ``closing`` m^2/s is distance times the speed at which it shrinks;
    ``speed_square`` m^2/s^2.
    """
    if distance_square <= REACH**2:
        return 0.0
    if closing <= 0.0:
        return math.inf
    speed_square = max(speed_square, 1e-12)
    nearest_square = max(distance_square - closing * closing / speed_square, 0.0)
    if nearest_square > MISS**2:
        return math.inf
    root = math.sqrt(max(REACH**2 - nearest_square, 0.0) * speed_square)
    return (closing - root) / speed_square
