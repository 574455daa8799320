"""Distances in the plane from the ways that something sweeps along."""

import numpy as np


def distance_to_way(point: np.ndarray, start: np.ndarray, end: np.ndarray, beyond: float) -> float:
    """Distance of a point from the way from start to end, all ``[2]`` m; m.

    The way goes on straight for ``beyond`` m behind its end: nobody stops dead.
    """
    way = end - start
    length = float(np.hypot(*way))
    direction = way / length
    along = np.clip(direction @ (point - start), 0.0, length + beyond)
    return float(np.hypot(*(point - (start + along * direction))))
