"""Billiards in which only a bank leads to the goal, and a scripted shooter that plays off a wall.

A cue that cannot get farther towards a wall than the ball strikes it only towards that wall: the
ball comes nearer to the goal, which is farther from that wall, only once it has bounced there.
"""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.billiards import (
    CUE,
    DISCS,
    GOAL_RADIUS,
    RESTITUTION,
    TABLE,
    TARGET,
    BilliardsLayout,
    BilliardsTask,
    free_place,
)
from contactgraph.envs.billiards_policies import TIME_CONSTANT, BilliardsExpert

_BLOCK = 0.07
"""Half the distance of the two pillars that stand in the direct way, m; the ball does not pass."""
_DIRECT = np.array([0.4, 1.0])
"""Distance from target to goal, at least and at most, m."""
_LONGEST = 1.6
"""The same along the way off the wall, m."""
_STRAIGHT = 0.995
"""Cosine of the angle between the cue's way and the shot from which the cue strikes."""
_RUN_UP = 0.35
"""Free length behind the target on the line of the shot, m."""
_CLEAR = 0.13
"""Least distance of the pillars from the way off the wall, m."""
_RADIUS = DISCS["ball"][1]
_TOUCH = DISCS["cue"][1] + _RADIUS
"""Distance of cue and ball as they touch, m."""
_BEHIND = 0.03
"""Least distance of the cue behind the ball, across the wall, m: a third of `_TOUCH`, with which
friction on the cue's side, a tenth of the impulse, does not carry the ball off the wall."""
_FARTHER = GOAL_RADIUS + 0.05
"""Least distance of the goal behind the ball, across the wall, m."""


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


def reach_before(target: np.ndarray, wall: int) -> np.ndarray:
    """[2, 2] m: bounds of a cue that stays farther from the wall than the target."""
    axis, side = wall % 2, 1 - 2 * (wall // 2)
    reach = np.full((2, 2), np.nan)
    reach[int(side > 0), axis] = target[axis] - side * _BEHIND
    return reach


def clearance(way: np.ndarray, pillars: np.ndarray) -> float:
    """The least distance of the pillars ``[P, 2]`` m from a way, m."""
    points = way.reshape(-1, 1, 2)
    return float(np.linalg.norm(points - pillars, axis=-1).min())


class BlockedShotTask(BilliardsTask):
    """Billiards with one ball, whose direct way to the goal two pillars block: it takes a bank.

    A `contactgraph.envs.Task`. The cue's reach (`Scene.reach`) ends behind the ball, as seen from a
    wall that is nearer to the ball than to the goal; the ball passes the bound. So the ball goes
    towards that wall first, off which every layout has a clear way to the goal.
    """

    name = "blocked-shot"

    def __init__(self) -> None:
        super().__init__(objects=1)

    def layout(self, rng: np.random.Generator) -> BilliardsLayout:
        """Samples layouts until the way off some wall is clear, and within the cue's reach."""
        while True:
            target, goal = rng.uniform(0.12 - TABLE, TABLE - 0.12, (2, 2))
            direct = goal - target
            length = float(np.linalg.norm(direct))
            if not _DIRECT[0] <= length <= _DIRECT[1]:
                continue
            across = _BLOCK * np.array([-direct[1], direct[0]]) / length
            pillars = np.stack([0.5 * (target + goal) + across, 0.5 * (target + goal) - across])
            walls = [wall for wall in range(4) if possible(target, goal, wall, pillars)]
            if not walls:
                continue
            reach = reach_before(target, int(rng.choice(walls)))
            places, radii = np.vstack([target, pillars]), np.array([_RADIUS, 0.06, 0.06])
            cue = free_place(rng, places, radii, DISCS["cue"][1], pillars, "cue")
            if cue is not None and inside(cue, reach):
                return BilliardsLayout(cue, target, goal, pillars, reach)


def inside(place: np.ndarray, reach: np.ndarray) -> bool:
    """Whether no bound leaves out a place ``[2]`` m."""
    return not np.any((place < reach[0]) | (place > reach[1]))


def possible(target: np.ndarray, goal: np.ndarray, wall: int, pillars: np.ndarray) -> bool:
    """Whether a shot off a wall, from behind the target, is clear of the pillars, within the table,
    not too long, and needed, as the goal is farther from the wall."""
    first, second = way = bank_way(target, goal, wall)
    shot = first[-1] - first[0]
    length = float(np.linalg.norm(shot))
    start = first[0] - _RUN_UP * shot / max(length, 1e-9)
    axis, side = wall % 2, 1 - 2 * (wall // 2)
    on_table = np.all(np.abs(first[-1]) <= TABLE - _RADIUS + 1e-9)
    on_table &= bool(np.all(np.abs(start) <= TABLE - 0.07))
    touch = first[0] - _TOUCH * shot / max(length, 1e-9)
    behind = inside(touch, reach_before(target, wall))
    behind &= bool(side * (target - goal)[axis] >= _FARTHER)
    total = length + float(np.linalg.norm(second[-1] - second[0]))
    run_up = np.linspace(start, first[0], 30)
    free = min(clearance(way, pillars), clearance(run_up, pillars)) >= _CLEAR
    return bool(on_table) and behind and length > 0.05 and total <= _LONGEST and free


class BankShotPolicy(BilliardsExpert):
    """`BilliardsExpert` that aims off the wall at which the cue's reach ends."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where the cue's reach is unknown."""
        super().reset(scene, seed)
        if not scene.has_reach:
            raise InvalidInputError("a bank shot needs the bound of the cue's reach, found none")
        assert scene.reach is not None
        upper, axis = np.argwhere(np.isfinite(scene.reach[CUE]))[0]
        self._wall = int(axis + 2 * (1 - upper))

    def aim(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[2] m: from the target towards the image of the goal, as long as the way of a ball that
        friction alone stops in the goal."""
        first, second = bank_way(position[TARGET], goal, self._wall)
        shot, rest = first[-1] - first[0], second[-1] - second[0]
        length = float(np.linalg.norm(shot))
        returned = 1.0 - (1.0 - RESTITUTION**2) * (shot[self._wall % 2] / length) ** 2
        return np.asarray(shot * (1.0 + np.linalg.norm(rest) / returned / length))

    def _velocity(self, position: np.ndarray, velocity: np.ndarray, shot: np.ndarray) -> np.ndarray:
        """[2] m/s, wanted of the cue: to where it touches the target on the line of the shot."""
        ahead = shot / np.linalg.norm(shot)
        way = position[TARGET] - _TOUCH * ahead - position[CUE]
        distance = float(np.linalg.norm(way))
        if way @ ahead < _STRAIGHT * distance or distance < 1e-3:
            return super()._velocity(position, velocity, shot)
        share = self._mass[CUE] / (self._mass[CUE] + self._mass[TARGET])
        after = np.sqrt(2.0 * self._slowdown * np.linalg.norm(shot))
        strike = after / ((1.0 + self._restitution) * share)
        return np.asarray((strike + self._slowdown * TIME_CONSTANT) * way / distance)
