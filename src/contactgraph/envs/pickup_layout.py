"""Sampled start positions and goals of pickups, with free paths for the gripper."""

import itertools
from dataclasses import dataclass

import numpy as np


def distance_to_path(point: np.ndarray, start: np.ndarray, end: np.ndarray, beyond: float) -> float:
    """Distance of a point from the path from start to end, all ``[2]`` m; m.

    The path continues straight for ``beyond`` m past its end, since no body stops at once.
    """
    path = end - start
    length = float(np.hypot(*path))
    direction = path / length
    along = np.clip(direction @ (point - start), 0.0, length + beyond)
    return float(np.hypot(*(point - (start + along * direction))))


HALF_WIDTH = 1.0
"""Half the side of the square that gripper, targets and goal lie in at the start, m."""
WIDENING = 0.5
"""Additional half side for distractors per target but the first, m."""
RADIUS = 0.04
"""Of every body, m."""
CLEARANCE = 0.06
"""The least gap between the surfaces of two bodies, m."""
REACH = 0.3
"""The least distance from each stop to the next, m: distance to gain speed."""
CORRIDOR = 0.35
"""The least distance of a distractor's centre from the paths, m."""
TARGET_CORRIDOR = 0.2
"""The least distance of a target's centre from the paths before its turn, m."""
STANDING_ROOM = 0.2
"""The least distance of a distractor in the way from each stop, m."""
IN_THE_WAY = 2
"""Distractors that a straight way touches, at least, where distractors are in the way."""
OVERSHOOT = 0.3
"""Length of a path past its end, m: no body stops at once."""

_TRIES_PER_DISTRACTOR = 200


@dataclass(frozen=True, eq=False)
class PickupLayout:
    """Start positions and goal of a pickup."""

    stops: np.ndarray
    """[K + 2, 2] m: gripper, targets in the order they are picked up, goal."""
    distractors: np.ndarray
    """[M, 2] m."""

    @property
    def position(self) -> np.ndarray:
        """[1 + K + M, 2] m: gripper, targets, distractors."""
        return np.concatenate([self.stops[:-1], self.distractors])

    @property
    def goal(self) -> np.ndarray:
        """[2] m."""
        return self.stops[-1]


def extent(targets: int) -> float:
    """Half the side of the square that contains everything at the start, m."""
    return HALF_WIDTH + WIDENING * (targets - 1)


def sample_layout(
    rng: np.random.Generator,
    targets: int,
    distractors: int,
    fixed: PickupLayout | None = None,
    in_the_way: bool = False,
    any_order: bool = False,
) -> PickupLayout:
    """Samples start positions and a goal, uniformly over those that satisfy the distances above.

    Distractors are clear of the paths; or, ``in_the_way``, they stand anywhere but at the stops,
    and a body that goes straight from stop to stop touches two of them or more. With ``any_order``
    no target stands on the way to or from another one, so that any may be carried, alone.

    With ``fixed``, the targets and the goal are those of this layout; all else is sampled. A
    layout without space for every distractor is rejected as a whole and sampled again, so that
    density does not bias the positions of gripper, targets and goal within a layout.
    """
    while True:
        stops = _uniform(rng, targets + 2, HALF_WIDTH)
        if fixed is not None:
            stops[1:] = fixed.stops[1:]
        if not _passable(stops, any_order):
            continue
        others = _place_distractors(rng, stops, distractors, in_the_way)
        if others is not None:
            return PickupLayout(stops, others)


def distance_to_paths(point: np.ndarray, stops: np.ndarray, beyond: float = OVERSHOOT) -> float:
    """Distance of ``point`` ``[2]`` m from the paths between stops ``[S, 2]`` m; m.

    All paths continue straight for ``beyond`` m past their ends.
    """
    return min(distance_to_path(point, *path, beyond) for path in itertools.pairwise(stops))


def _passable(stops: np.ndarray, any_order: bool) -> bool:
    """Whether stops are far enough apart, and later targets are clear of earlier paths.

    With ``any_order`` each target is also clear of the paths to and from every other one.
    """
    if min(itertools.starmap(_distance, itertools.pairwise(stops))) < REACH:
        return False
    goal = len(stops) - 1
    cleared = [(due, index, index + 1) for index in range(goal) for due in range(index + 2, goal)]
    if any_order:
        for one, other in itertools.permutations(range(1, goal), 2):
            cleared += [(other, 0, one), (other, one, goal)]
    return all(
        distance_to_path(stops[due], stops[start], stops[end], OVERSHOOT) >= TARGET_CORRIDOR
        for due, start, end in cleared
    )


def _place_distractors(
    rng: np.random.Generator, stops: np.ndarray, count: int, in_the_way: bool
) -> np.ndarray | None:
    """[count, 2] m, or None if no space was left, or too few are in the way."""
    placed: list[np.ndarray] = []
    for point in _uniform(rng, _TRIES_PER_DISTRACTOR * count, extent(len(stops) - 2)):
        if len(placed) == count:
            break
        if any(_distance(point, other) < 2 * RADIUS + CLEARANCE for other in placed):
            continue
        if in_the_way:
            free = all(_distance(point, stop) >= STANDING_ROOM for stop in stops)
        else:
            free = distance_to_paths(point, stops) >= CORRIDOR
        if free:
            placed.append(point)
    crossed = sum(distance_to_paths(each, stops, 0.0) < 2 * RADIUS for each in placed)
    if len(placed) < count or (in_the_way and crossed < IN_THE_WAY):
        return None
    return np.reshape(placed, (count, 2))


def _uniform(rng: np.random.Generator, count: int, half_width: float) -> np.ndarray:
    inside = half_width - RADIUS
    return rng.uniform(-inside, inside, (count, 2))


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.hypot(*(a - b)))
