"""The pickup of the arm, simulated or real: constants, scene, cost and start layouts."""

import itertools
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.pickup_layout import distance_to_path

HAND, TARGET = 0, 1
"""Nodes."""
APPARENT_MASS = 4.0
"""Mass of the hand under impedance control, kg; about the arm's own inertia there."""
BLOCK = np.array([0.04, 0.04, 0.1])
"""Sides of a block, m."""
BLOCK_MASS = 0.4
"""kg"""
GRAVITY = np.array([0.0, 0.0, -9.81])
"""m/s^2"""
GOAL_RADIUS = 0.05
"""Largest final distance of the block from the goal, m."""
CONTACT_DISTANCE = 0.0165
"""Distance of the grasp point from a block's centre when the fingers touch it, m; an upper bound
for nearly all grasps."""
PICK_WEIGHTS = np.array([10.0, 10.0, 100.0, 0.1, 0.1, 5.0])
"""The large weight on z brings the hand down before it arrives, to sweep at the block's height."""
GOAL_WEIGHTS = np.array([30.0, 30.0, 30.0, 3.0, 3.0, 3.0])
"""A weight of 100 bends the path towards the goal, and a finger strikes the block's corner."""
CONTROL_WEIGHT = 0.01
_GRASP_DISTANCE = 0.03
"""m: a lifted block this close to the grasp point is grasped; its half diagonal is 0.028 m."""
MAX_FORCE = 20.0
"""Bound of the control on each axis, N."""

LOW = np.array([0.3, -0.35, 0.05])
HIGH = np.array([0.7, 0.35, 0.35])
"""Corners of the paper's region, 0.4 x 0.7 x 0.3 m, in the frame of the arm's base, m."""
START_HEIGHT = 0.15
"""Least height of the hand and of the goal, m."""
RUN_UP = 0.2
"""Least distance from hand to block and from block to goal in the plane, m."""
CORRIDOR = 0.15
"""Least distance of a distractor from the path in the plane, m; the palm is 0.2 m wide."""
CLEARANCE = 0.1
"""Least distance between the centres of two blocks, m."""
OVERSHOOT = 0.15
"""Length of path kept free beyond its end, m."""
REACH = 0.74
"""Largest distance from the base in the plane with the hand pointing down, m."""
NEAR = 0.28
"""Least distance from the base in the plane, m."""
EDGE = 0.03
"""Least distance of blocks from the edge of the region, m."""


class Grasp(StrEnum):
    """Coupling between the hand and a grasped block."""

    FRICTION = "friction"
    """The fingers hold the block by friction."""
    WELD = "weld"
    """The block is welded to the hand as soon as both fingers touch it."""


@dataclass(frozen=True, eq=False)
class ArmLayout:
    """Start and goal of a pickup by the arm."""

    hand: np.ndarray
    """[3] m: the grasp point."""
    yaw: float
    """rad; the line through the fingers is perpendicular to the path to the block."""
    blocks: np.ndarray
    """[1 + M, 3] m: the target, then the distractors."""
    block_yaw: np.ndarray
    """[1 + M] rad; the target faces the hand."""
    goal: np.ndarray
    """[3] m"""


def pickup_cost() -> ChainCost:
    """Cost of hand to block and block to goal."""
    return ChainCost((HAND, TARGET), PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)


def pickup_scene(dt: float, goal: np.ndarray, block_mass: float | None = None) -> Scene:
    """A hand and one block with time steps of ``dt`` s; ``goal`` [3] m.

    ``block_mass`` kg is optional. Raises `InvalidInputError` as `Scene` does.
    """
    return Scene(
        node_name=("hand", "block"),
        node_type=("hand", "block"),
        actuated=np.array([True, False]),
        dt=dt,
        dimension=3,
        goal=goal,
        gravity=GRAVITY.copy(),
        mass=None if block_mass is None else np.array([APPARENT_MASS, block_mass]),
        size=np.array([[np.nan] * 3, BLOCK]),
        metadata={
            "task": "franka",
            "goal_radius": GOAL_RADIUS,
            "contact_distance": CONTACT_DISTANCE,
        },
    )


def is_success(position: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the hand holds the block at the goal, from ``position`` [N, 3] m and ``goal`` [3] m.

    For arms without contact sensing.
    """
    if position.shape[0] <= TARGET:
        raise InvalidInputError(f"position must be of a hand and a block, found {position.shape}")
    at_goal = float(np.linalg.norm(position[TARGET] - goal)) <= GOAL_RADIUS
    return at_goal and float(np.linalg.norm(position[TARGET] - position[HAND])) <= _GRASP_DISTANCE


def sample_layout(
    rng: np.random.Generator, distractors: int, fixed: ArmLayout | None = None
) -> ArmLayout:
    """Samples a layout, uniformly over those that satisfy the distances above.

    With ``fixed``, the target and the goal are those of this layout; all else is sampled.
    """
    while True:
        hand, target, goal = rng.uniform(LOW, HIGH, (3, 3))
        target[:2] = rng.uniform(LOW[:2] + EDGE, HIGH[:2] - EDGE)
        target[2] = BLOCK[2] / 2
        if fixed is not None:
            target, goal = fixed.blocks[0], fixed.goal
        if min(hand[2], goal[2]) < START_HEIGHT:
            continue
        first, second = target - hand, goal - target
        if min(np.hypot(*first[:2]), np.hypot(*second[:2])) < RUN_UP:
            continue
        # The hand brakes behind the block.
        beyond = target + OVERSHOOT * first / np.hypot(*first[:2])
        if not reachable(hand, target, goal, beyond):
            continue
        others = _distractors(rng, np.stack([hand, target, goal])[:, :2], distractors)
        if others is None:
            continue
        blocks = np.concatenate([target[None], others])
        yaw = sweep_yaw(hand, target)
        block_yaw = np.concatenate([[yaw], rng.uniform(-np.pi / 4, np.pi / 4, distractors)])
        return ArmLayout(hand, yaw, blocks, block_yaw, goal)


def reachable(*points: np.ndarray) -> bool:
    """Whether the arm, with its hand pointing down, reaches each of ``points`` [3] m."""
    return all(NEAR <= np.hypot(*point[:2]) <= REACH for point in points)


def sweep_yaw(hand: np.ndarray, target: np.ndarray) -> float:
    """Yaw of the hand, rad, with its fingers across the path from ``hand`` to ``target``, [3] m."""
    path = target - hand
    # The fingers are symmetric under half a turn, and the range of the last joint is limited.
    turned = np.arctan2(path[1], path[0]) - np.arctan2(target[1], target[0]) - np.pi / 4
    bearing = float(np.arctan2(target[1], target[0])) + np.pi / 4
    return bearing + float((turned + np.pi / 2) % np.pi - np.pi / 2)


def sweep_fits(hand: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a sweep from ``hand`` through ``target`` stays in a box and within the arm's reach.

    All [3] m. The virtual walls slow the hand down, so the path ends `OVERSHOOT` before them.
    """
    path = (target - hand)[:2]
    beyond = target[:2] + OVERSHOOT * path / np.hypot(*path)
    end_inside = np.all(beyond >= low[:2] + EDGE) and np.all(beyond <= high[:2] - EDGE)
    start_inside = np.all(hand >= low + EDGE) and np.all(hand <= high - EDGE)
    return bool(end_inside and start_inside and reachable(hand, target, beyond))


def sweep_start(
    target: np.ndarray, yaw: float, goal: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray | None:
    """[3] m: the start of a sweep through ``target`` as straight towards ``goal`` as possible.

    The path is perpendicular to a side of the target, whose yaw is ``yaw`` rad, since its corners
    do not fit between the open fingers. ``low`` and ``high`` [3] m bound the hand. None if no such
    start exists.
    """
    onward = np.arctan2(goal[1] - target[1], goal[0] - target[0])
    sides = [yaw + side * np.pi / 2.0 for side in range(4)]
    for bearing in sorted(sides, key=lambda each: -np.cos(each - onward)):
        along = np.array([np.cos(bearing), np.sin(bearing)])
        hand = np.array([*(target[:2] - 1.2 * RUN_UP * along), START_HEIGHT + EDGE])
        if sweep_fits(hand, target, low, high):
            return hand
    return None


def _distractors(rng: np.random.Generator, stops: np.ndarray, count: int) -> np.ndarray | None:
    """[count, 3] m, clear of the paths between ``stops`` [3, 2] m; None if too few were found."""
    chosen: list[np.ndarray] = []
    for point in rng.uniform(LOW[:2] + EDGE, HIGH[:2] - EDGE, (100 * count, 2)):
        if len(chosen) == count:
            break
        clear = all(np.hypot(*(point - other[:2])) >= CLEARANCE for other in chosen)
        gaps = [distance_to_path(point, *path, OVERSHOOT) for path in itertools.pairwise(stops)]
        if clear and min(gaps) >= CORRIDOR:
            chosen.append(np.array([*point, BLOCK[2] / 2]))
    return np.reshape(chosen, (count, 3)) if len(chosen) == count else None
