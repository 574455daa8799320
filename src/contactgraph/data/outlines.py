"""Outlines of recorded bodies: convex polygons in the plane, convex hulls of points in space."""

from functools import lru_cache
from typing import Any

import numpy as np

from contactgraph.data.errors import InvalidInputError

_FLAT = 1e-9
"""One minus the cosine of the angle of two triangles of one face."""


def hull_rows(points: np.ndarray) -> np.ndarray:
    """[V, 5, 3] m: the surface of the convex hull of points [n, 3] m, row by row.

    A row holds the corners of a triangle, counter-clockwise from outside, and the two ends of an
    edge. The rows hold all triangles and all edges, some of them twice, and every vertex begins the
    edge of some row. Raises `InvalidInputError` where the points lie in a plane.
    """
    rounded = np.asarray(points, np.float64)
    return _hull_rows(rounded.tobytes())


@lru_cache(maxsize=256)
def _hull_rows(data: bytes) -> np.ndarray:
    points = np.frombuffer(data).reshape(-1, 3)
    hull = _hull(points)
    corners, normal = hull.simplices.copy(), hull.equations[:, :3]
    one, other, third = points[corners].swapaxes(0, 1)
    inward = np.sum(np.cross(other - one, third - one) * normal, axis=1) < 0.0
    corners[inward] = corners[inward][:, ::-1]
    edges: set[tuple[int, int]] = set()
    for index, around in enumerate(hull.neighbors):
        for corner, neighbour in enumerate(around):
            if neighbour > index and normal[index] @ normal[neighbour] < 1.0 - _FLAT:
                ends = np.delete(hull.simplices[index], corner)
                edges.add((int(ends.min()), int(ends.max())))
    begins = _begun(sorted(edges))
    count = max(len(corners), len(begins))
    rows = [corners[np.arange(count) % len(corners)], begins[np.arange(count) % len(begins)]]
    found = points[np.concatenate(rows, axis=1)]
    found.flags.writeable = False
    return found


def _hull(points: np.ndarray) -> Any:
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        raise InvalidInputError(
            f"polygons in space must be at least 4 points that do not lie in a plane, found "
            f"{points.tolist()}"
        ) from None


def _begun(edges: list[tuple[int, int]]) -> np.ndarray:
    """[edges, 2] the ends, in such an order that every vertex begins one of them."""
    from scipy.optimize import linear_sum_assignment

    vertices = sorted({each for edge in edges for each in edge})
    apart = np.array([[float(vertex not in edge) for edge in edges] for vertex in vertices])
    begins = dict(zip(*linear_sum_assignment(apart)[::-1], strict=True))
    return np.array(
        [
            edge[::-1] if index in begins and vertices[begins[index]] == edge[1] else edge
            for index, edge in enumerate(edges)
        ]
    )


def outline_moments(outline: np.ndarray) -> tuple[float, np.ndarray]:
    """The area, m^2, of an outline [V, 2] m that runs counter-clockwise, and the squared radius of
    gyration about the origin, m^2; of a hull of points [V, 3] m its volume, m^3, and the three
    about the axes of the frame."""
    if outline.shape[1] == 3:
        return _hull_moments(outline)
    following = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    squares = np.sum(outline**2 + outline * following + following**2, axis=1)
    area = signed_area(outline)
    return area, np.asarray(float(cross @ squares) / 12.0 / area)


def _hull_moments(points: np.ndarray) -> tuple[float, np.ndarray]:
    corners = hull_rows(points)[: len(_hull(points).simplices), :3]
    one, other, third = corners.swapaxes(0, 1)
    # Of tetrahedra from the origin.
    volume = np.sum(np.cross(one, other) * third, axis=1) / 6.0
    square = one**2 + other**2 + third**2 + one * other + other * third + third * one
    moment = volume @ square / 10.0
    return float(volume.sum()), (moment.sum() - moment) / volume.sum()


def check_outline(name: str, outline: np.ndarray) -> None:
    """Raises `InvalidInputError` for an outline [V, 2] m that is not convex, or points [V, 3] m in
    a plane; ``name`` is its name in the error."""
    if outline.shape[1] == 3:
        hull_rows(outline)
    elif not _is_convex(outline):
        raise InvalidInputError(f"{name} must be convex, found {outline.tolist()}")


def _is_convex(outline: np.ndarray) -> bool:
    """Whether all corners turn the same way; [V, 2]."""
    side = np.roll(outline, -1, axis=0) - outline
    following = np.roll(side, -1, axis=0)
    turn = side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0]
    return bool(turn.any() and (np.all(turn >= 0.0) or np.all(turn <= 0.0)))


def signed_area(outline: np.ndarray) -> float:
    """m^2, of an outline [V, 2] m; positive where it runs counter-clockwise."""
    following = np.roll(outline, -1, axis=0)
    return float(0.5 * np.sum(outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]))
