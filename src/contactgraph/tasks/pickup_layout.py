"""Where things lie when a pickup begins."""

from dataclasses import dataclass

import numpy as np

HALF_WIDTH = 1.0
"""Half the side of the square that everything lies in at the start, m."""
RADIUS = 0.04
"""Of every body, m."""
CLEARANCE = 0.06
"""The least gap between the surfaces of two bodies, m."""
REACH = 0.3
"""The least distance from gripper to target and from target to goal, m: way to gain speed on."""
CORRIDOR = 0.35
"""The least distance of a distractor's centre from the ways, m."""
OVERSHOOT = 0.3
"""By how much a way is longer than the straight line, m: nobody stops dead."""

_TRIES_PER_DISTRACTOR = 200


@dataclass(frozen=True, eq=False)
class PickupLayout:
    """Start positions and goal of a pickup."""

    position: np.ndarray
    """[N, 2] m: gripper, target, distractors."""
    goal: np.ndarray
    """[2] m."""


def sample_layout(rng: np.random.Generator, distractors: int) -> PickupLayout:
    """Samples start positions and a goal, uniformly over those that satisfy the distances above.

    A layout without room for every distractor is given up and sampled afresh as a whole, so that
    crowding does not bias where the gripper, the target and the goal are within a layout.
    """
    while True:
        gripper, target, goal = _uniform(rng, 3)
        if min(_distance(gripper, target), _distance(target, goal)) < REACH:
            continue
        others = _place_distractors(rng, gripper, target, goal, distractors)
        if others is not None:
            return PickupLayout(np.concatenate([[gripper, target], others]), goal)


def distance_to_ways(point: np.ndarray, layout: PickupLayout) -> float:
    """Distance of ``point`` ``[2]`` m from the ways gripper to target and target to goal, m.

    Both ways go on straight for `OVERSHOOT` beyond their ends.
    """
    gripper, target = layout.position[:2]
    return _distance_to_ways(point, gripper, target, layout.goal)


def _place_distractors(
    rng: np.random.Generator,
    gripper: np.ndarray,
    target: np.ndarray,
    goal: np.ndarray,
    count: int,
) -> np.ndarray | None:
    """[count, 2] m, or None where no room was found."""
    placed: list[np.ndarray] = []
    for point in _uniform(rng, _TRIES_PER_DISTRACTOR * count):
        if len(placed) == count:
            break
        free = all(_distance(point, other) >= 2 * RADIUS + CLEARANCE for other in placed)
        if free and _distance_to_ways(point, gripper, target, goal) >= CORRIDOR:
            placed.append(point)
    return np.reshape(placed, (count, 2)) if len(placed) == count else None


def _uniform(rng: np.random.Generator, count: int) -> np.ndarray:
    inside = HALF_WIDTH - RADIUS
    return rng.uniform(-inside, inside, (count, 2))


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.hypot(*(a - b)))


def _distance_to_ways(
    point: np.ndarray, gripper: np.ndarray, target: np.ndarray, goal: np.ndarray
) -> float:
    return min(_distance_to_way(point, gripper, target), _distance_to_way(point, target, goal))


def _distance_to_way(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    length = _distance(start, end)
    direction = (end - start) / length
    along = np.clip(direction @ (point - start), 0.0, length + OVERSHOOT)
    return _distance(point, start + along * direction)
