"""What the arm's pickup is about, on a simulated arm and on a real one; no simulator is needed."""

import itertools
from dataclasses import dataclass
from enum import Enum

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.pickup_layout import distance_to_way

HAND, TARGET = 0, 1
"""Nodes."""
APPARENT_MASS = 4.0
"""What the hand feels like to a force, kg: about what an arm weighs there."""
BLOCK = np.array([0.04, 0.04, 0.1])
"""Sides of a block, m."""
GRAVITY = np.array([0.0, 0.0, -9.81])
"""m/s^2"""
GOAL_RADIUS = 0.05
"""The block must end within this distance of the goal, m."""
CONTACT_DISTANCE = 0.0165
"""How near the grasp point is to a block's centre when fingers touch it; hardly ever farther; m."""
PICK_WEIGHTS = np.array([10.0, 10.0, 100.0, 0.1, 0.1, 5.0])
"""The hand comes down before it arrives: it sweeps through the block at its height."""
GOAL_WEIGHTS = np.array([30.0, 30.0, 30.0, 3.0, 3.0, 3.0])
"""With 100 the way to the block bends towards the goal, and a finger strikes the block's corner."""
CONTROL_WEIGHT = 0.01
_HELD = 0.03
"""m: a block in the air that is so near to the grasp point is held; its half diagonal is 0.028."""


MAX_FORCE = 20.0
"""Bound of the control on each axis, N."""


class Grasp(Enum):
    """How the hand holds a block."""

    FRICTION = "friction"
    """By what its fingers press."""
    WELD = "weld"
    """Rigidly, from the moment both fingers touch it."""


def pickup_cost() -> ChainCost:
    """Hand to block, block to goal."""
    return ChainCost((HAND, TARGET), PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)


def pickup_scene(dt: float, goal: np.ndarray, block_mass: float | None = None) -> Scene:
    """An arm's hand and one block, with steps of ``dt`` s; ``goal`` [3] m.

    ``block_mass`` kg where it is known. Raises `InvalidInputError` as `Scene` does.
    """
    mass = None if block_mass is None else np.array([APPARENT_MASS, block_mass])
    return Scene(
        node_name=("hand", "block"),
        node_type=("hand", "block"),
        actuated=np.array([True, False]),
        dt=dt,
        dimension=3,
        goal=goal,
        gravity=GRAVITY.copy(),
        mass=mass,
        size=np.array([[np.nan] * 3, BLOCK]),
        metadata={
            "task": "franka",
            "goal_radius": GOAL_RADIUS,
            "contact_distance": CONTACT_DISTANCE,
        },
    )


def is_success(position: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the hand holds the block at the goal, from places alone; [N, 3] m and [3] m.

    For arms that cannot say what their fingers touch.
    """
    if position.shape[0] <= TARGET:
        raise InvalidInputError(f"position must be of a hand and a block, found {position.shape}")
    near = float(np.linalg.norm(position[TARGET] - goal)) <= GOAL_RADIUS
    return near and float(np.linalg.norm(position[TARGET] - position[HAND])) <= _HELD


LOW = np.array([0.3, -0.35, 0.05])
HIGH = np.array([0.7, 0.35, 0.35])
"""The region of the paper, 0.4 x 0.7 x 0.3 m, as seen from the arm's base; m."""
START_HEIGHT = 0.15
"""The least height of the hand and of the goal, m."""
RUN_UP = 0.2
"""The least distance from hand to block and from block to goal in the plane, m."""
CORRIDOR = 0.15
"""The least distance of a distractor from the ways in the plane, m: the palm is 0.2 m wide."""
CLEARANCE = 0.1
"""The least distance of two blocks' centres, m."""
OVERSHOOT = 0.15
"""By how much a way is longer than the straight line, m."""
REACH = 0.74
"""Of the arm in the plane, from its base, with the hand pointing down; m."""
NEAR = 0.28
"""The least distance from the base in the plane, m."""
EDGE = 0.03
"""How far from the region's edge blocks stand, m."""


@dataclass(frozen=True, eq=False)
class ArmLayout:
    """Start and goal of a pickup by the arm."""

    hand: np.ndarray
    """[3] m: the grasp point."""
    yaw: float
    """rad; the fingers' line is across the way to the block."""
    blocks: np.ndarray
    """[1 + M, 3] m: the target, the distractors."""
    block_yaw: np.ndarray
    """[1 + M] rad; the target faces the hand."""
    goal: np.ndarray
    """[3] m"""


def sample_layout(
    rng: np.random.Generator, distractors: int, fixed: ArmLayout | None = None
) -> ArmLayout:
    """Samples a layout, uniformly over those that satisfy the distances above.

    With ``fixed``, the target's place and the goal are those of this layout; all else is sampled.
    """
    while True:
        hand, target, goal = rng.uniform(LOW, HIGH, (3, 3))
        target[:2] = rng.uniform(LOW[:2] + EDGE, HIGH[:2] - EDGE)
        target[2] = BLOCK[2] / 2
        if fixed is not None:
            target, goal = fixed.blocks[0], fixed.goal
        if min(hand[2], goal[2]) < START_HEIGHT:
            continue
        way, on = target - hand, goal - target
        if min(np.hypot(*way[:2]), np.hypot(*on[:2])) < RUN_UP:
            continue
        # Nobody stops dead: there must be room behind the block.
        beyond = target + OVERSHOOT * way / np.hypot(*way[:2])
        if not all(NEAR <= np.hypot(*p[:2]) <= REACH for p in (hand, target, goal, beyond)):
            continue
        others = _place(rng, np.stack([hand, target, goal])[:, :2], distractors)
        if others is None:
            continue
        blocks = np.concatenate([target[None], others])
        yaw = sweep_yaw(hand, target)
        block_yaw = np.concatenate([[yaw], rng.uniform(-np.pi / 4, np.pi / 4, distractors)])
        return ArmLayout(hand, yaw, blocks, block_yaw, goal)


def sweep_yaw(hand: np.ndarray, target: np.ndarray) -> float:
    """rad: with the fingers' line across the way from ``hand`` to ``target``, each [3] m."""
    way = target - hand
    # Sweeping forth and back are alike to the fingers; the last joint's range is not endless.
    turned = np.arctan2(way[1], way[0]) - np.arctan2(target[1], target[0]) - np.pi / 4
    bearing = float(np.arctan2(target[1], target[0])) + np.pi / 4
    return bearing + float((turned + np.pi / 2) % np.pi - np.pi / 2)


def sweep_fits(hand: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a sweep from ``hand`` through ``target`` stays in a box, and where the arm reaches.

    All [3] m. Guards slow a hand down before a wall: ends of the way keep `OVERSHOOT` from it.
    """
    way = (target - hand)[:2]
    beyond = target[:2] + OVERSHOOT * way / np.hypot(*way)
    inside = np.all(beyond >= low[:2] + EDGE) and np.all(beyond <= high[:2] - EDGE)
    began = np.all(hand >= low + EDGE) and np.all(hand <= high - EDGE)
    reached = all(NEAR <= np.hypot(*point[:2]) <= REACH for point in (hand, target, beyond))
    return bool(inside and began and reached)


def sweep_start(
    target: np.ndarray, yaw: float, goal: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray | None:
    """[3] m: from where a hand sweeps through ``target`` towards ``goal``, or most nearly so.

    The way is across a side of the target, which is turned by ``yaw`` rad: between open fingers
    there is no room for its corners. ``low`` and ``high`` [3] m are the box that the hand must stay
    in. None where there is no such place.
    """
    onward = np.arctan2(goal[1] - target[1], goal[0] - target[0])
    sides = [yaw + side * np.pi / 2.0 for side in range(4)]
    for bearing in sorted(sides, key=lambda each: -np.cos(each - onward)):
        along = np.array([np.cos(bearing), np.sin(bearing)])
        hand = np.array([*(target[:2] - 1.2 * RUN_UP * along), START_HEIGHT + EDGE])
        if sweep_fits(hand, target, low, high):
            return hand
    return None


def _place(rng: np.random.Generator, stops: np.ndarray, count: int) -> np.ndarray | None:
    """[count, 3] m of distractors, or None where no room was found."""
    placed: list[np.ndarray] = []
    for point in rng.uniform(LOW[:2] + EDGE, HIGH[:2] - EDGE, (100 * count, 2)):
        if len(placed) == count:
            break
        clear = all(np.hypot(*(point - other[:2])) >= CLEARANCE for other in placed)
        ways = [distance_to_way(point, *way, OVERSHOOT) for way in itertools.pairwise(stops)]
        if clear and min(ways) >= CORRIDOR:
            placed.append(np.array([*point, BLOCK[2] / 2]))
    return np.reshape(placed, (count, 3)) if len(placed) == count else None
