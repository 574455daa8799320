"""Billiards with the direct way blocked, and a scripted shooter that plays off a wall."""

import numpy as np

from contactgraph.envs.billiards import (
    DISCS,
    RESTITUTION,
    TABLE,
    TARGET,
    BilliardsLayout,
    BilliardsTask,
    free_place,
)
from contactgraph.envs.billiards_policies import BilliardsExpert

_BLOCK = 0.07
"""Half the distance of the two pillars that stand in the direct way, m; the ball does not pass."""
_DIRECT = np.array([0.4, 1.0])
"""Distance from target to goal, at least and at most, m."""
_LONGEST = 1.6
"""The same along the way off the wall, m."""
_RUN_UP = 0.35
"""Free length behind the target on the line of the shot, m."""
_CLEAR = 0.13
"""Least distance of the pillars from the way off the wall, m."""
_RADIUS = DISCS["ball"][1]


def images(goal: np.ndarray) -> np.ndarray:
    """[4, 2] m: where to aim, wall after wall, for a ball that reaches ``goal`` off it.

    A bounce takes back the share 0.9 of the velocity across the wall, so that the image is farther
    behind it than the goal is before it.
    """
    found = np.tile(goal, (4, 1))
    for wall in range(4):
        axis, side = wall % 2, 1 - 2 * (wall // 2)
        at = side * (TABLE[axis] - _RADIUS)
        found[wall, axis] = at + (at - goal[axis]) / RESTITUTION
    return found


def bank_way(target: np.ndarray, goal: np.ndarray, wall: int) -> np.ndarray:
    """[2, 30, 2] m: points from the target to the wall, and from there to the goal."""
    axis, side = wall % 2, 1 - 2 * (wall // 2)
    aim = images(goal)[wall]
    share = (side * (TABLE[axis] - _RADIUS) - target[axis]) / (aim[axis] - target[axis])
    turn = target + share * (aim - target)
    return np.stack([np.linspace(target, turn, 30), np.linspace(turn, goal, 30)])


def clearance(way: np.ndarray, pillars: np.ndarray) -> float:
    """The least distance of the pillars ``[P, 2]`` m from a way, m."""
    points = way.reshape(-1, 1, 2)
    return float(np.linalg.norm(points - pillars, axis=-1).min())


class BlockedShotTask(BilliardsTask):
    """Billiards with one ball, whose direct way to the goal two pillars block.

    A `contactgraph.envs.Task`. The ball may come off a wall, for which every layout has a clear
    way, or round the pillars by several strikes.
    """

    name = "blocked-shot"

    def __init__(self) -> None:
        super().__init__(objects=1)

    def layout(self, rng: np.random.Generator) -> BilliardsLayout:
        """Samples layouts until the way off some wall is clear."""
        while True:
            target, goal = rng.uniform(0.12 - TABLE, TABLE - 0.12, (2, 2))
            direct = goal - target
            length = float(np.linalg.norm(direct))
            if not _DIRECT[0] <= length <= _DIRECT[1]:
                continue
            across = _BLOCK * np.array([-direct[1], direct[0]]) / length
            pillars = np.stack([0.5 * (target + goal) + across, 0.5 * (target + goal) - across])
            ways = [bank_way(target, goal, wall) for wall in range(4)]
            if not any(possible(way, pillars) for way in ways):
                continue
            places, radii = np.vstack([target, pillars]), np.array([_RADIUS, 0.06, 0.06])
            cue = free_place(rng, places, radii, DISCS["cue"][1], pillars, "cue")
            if cue is not None:
                return BilliardsLayout(cue, target, goal, pillars)


def possible(way: np.ndarray, pillars: np.ndarray) -> bool:
    """Whether a shot on this way is clear of the pillars, within the table, and not too long."""
    first, second = way
    shot = first[-1] - first[0]
    length = float(np.linalg.norm(shot))
    start = first[0] - _RUN_UP * shot / max(length, 1e-9)
    inside = np.all(np.abs(first[-1]) <= TABLE - _RADIUS + 1e-9)
    inside &= bool(np.all(np.abs(start) <= TABLE - 0.07))
    total = length + float(np.linalg.norm(second[-1] - second[0]))
    run_up = np.linspace(start, first[0], 30)
    free = min(clearance(way, pillars), clearance(run_up, pillars)) >= _CLEAR
    return bool(inside) and length > 0.05 and total <= _LONGEST and free


class BankShotPolicy(BilliardsExpert):
    """`BilliardsExpert` that aims off the wall of the shortest possible way."""

    def aim(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[2] m: from the target to the image of the goal."""
        target, pillars = position[TARGET], position[TARGET + 1 :]
        free = [possible(bank_way(target, goal, wall), pillars) for wall in range(4)]
        short = np.linalg.norm(images(goal) - target, axis=-1)
        wall = int(np.argmin(short + 10.0 * ~np.array(free)))
        return np.asarray(images(goal)[wall] - target)
