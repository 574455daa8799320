"""Where the gripper and the doors are when an episode with a door begins."""

from dataclasses import dataclass

import numpy as np

LENGTH = 1.0
"""Of every door, m."""
THICKNESS = 0.05
"""Of every door, m."""
HALF_WIDTH = 1.0
"""Half the side of the square that the gripper starts in, m."""
HINGE_HALF_WIDTH = 0.2
"""Half the side of the square that the target door's hinge lies in, m."""
DISTRACTOR_HALF_WIDTH = 3.0
"""Half the side of the square that the distractors' hinges lie in, m."""
REACH = 0.4
"""The least distance of the gripper's centre from the door's middle line, m: way to gain speed."""
STEEPEST = np.deg2rad(60.0)
"""The way to the door's middle is at most this far from perpendicular to the door, rad."""
SMALLEST_SWING = np.deg2rad(20.0)
"""From the initial to the goal angle, rad."""
LARGEST_SWING = np.deg2rad(80.0)
"""From the initial to the goal angle, rad."""
OVERSHOOT = np.deg2rad(20.0)
"""By how much a door may swing beyond its initial and its goal angle, rad."""
CORRIDOR = 0.35
"""The least distance of a distractor from the swept area, from the way and from others, m."""

_SPACING = 0.05
"""Between the points that stand for a line, m: 1 mm of `CORRIDOR`."""
_TRIES_PER_DISTRACTOR = 200


@dataclass(frozen=True, eq=False)
class DoorLayout:
    """Start and goal of an episode; door 0 is the target, the others stand by."""

    gripper: np.ndarray
    """[2] m."""
    hinge: np.ndarray
    """[1 + M, 2] m."""
    angle: np.ndarray
    """[1 + M] rad, of the way from the hinge to the door's middle."""
    goal_angle: float
    """Of door 0, rad."""


def middle(hinge: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """[..., 2] m: the middles of doors with hinges ``[..., 2]`` m at angles ``[...]`` rad."""
    return hinge + 0.5 * LENGTH * _direction(angle)


def sample_layout(
    rng: np.random.Generator, distractors: int, fixed: DoorLayout | None = None
) -> DoorLayout:
    """Samples a layout, uniformly over those that satisfy the distances above.

    With ``fixed``, door 0 and its goal are those of this layout; all else is sampled. A layout
    without room for every distractor is given up and sampled afresh as a whole.
    """
    while True:
        hinge = rng.uniform(-HINGE_HALF_WIDTH, HINGE_HALF_WIDTH, 2)
        angle = rng.uniform(-np.pi, np.pi)
        swing = rng.uniform(SMALLEST_SWING, LARGEST_SWING) * rng.choice([-1.0, 1.0])
        goal_angle = float(angle + swing)
        gripper = rng.uniform(-HALF_WIDTH, HALF_WIDTH, 2)
        if fixed is not None:
            hinge, angle, goal_angle = fixed.hinge[0], float(fixed.angle[0]), fixed.goal_angle
        way = middle(hinge, angle) - gripper
        steep = abs(way @ _direction(angle)) > np.sin(STEEPEST) * np.linalg.norm(way)
        if steep or _distance(gripper[None], _bar(hinge, angle)) < REACH:
            continue
        low, high = sorted([angle, goal_angle])
        turns = np.arange(low - OVERSHOOT, high + OVERSHOOT, _SPACING / LENGTH)
        taken = [_line(gripper, gripper + way), *(_bar(hinge, turn) for turn in turns)]
        others = _place_distractors(rng, np.concatenate(taken), distractors)
        if others is not None:
            hinges, angles = np.vstack([hinge, others[:, :2]]), np.append(angle, others[:, 2])
            return DoorLayout(gripper, hinges, angles, goal_angle)


def _place_distractors(
    rng: np.random.Generator, taken: np.ndarray, count: int
) -> np.ndarray | None:
    """[count, 3] hinge m and angle rad, clear of ``taken`` ``[P, 2]`` m; None where no room was."""
    placed: list[np.ndarray] = []
    bound = np.array([DISTRACTOR_HALF_WIDTH, DISTRACTOR_HALF_WIDTH, np.pi])
    for candidate in rng.uniform(-bound, bound, (_TRIES_PER_DISTRACTOR * count, 3)):
        if len(placed) == count:
            break
        bar = _bar(candidate[:2], candidate[2])
        if _distance(bar, taken) >= CORRIDOR:
            placed.append(candidate)
            taken = np.concatenate([taken, bar])
    return np.reshape(placed, (count, 3)) if len(placed) == count else None


def _direction(angle: np.ndarray | float) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _bar(hinge: np.ndarray, angle: float) -> np.ndarray:
    """[P, 2] m: the middle line of a door."""
    return _line(hinge, hinge + LENGTH * _direction(angle))


def _line(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """[P, 2] m: points that stand for the line."""
    count = 2 + int(np.linalg.norm(end - start) / _SPACING)
    return np.linspace(start, end, count)


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one[:, None] - other, axis=-1).min())
