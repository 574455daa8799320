"""What the arm's pickup is about, on a simulated arm and on a real one; no simulator is needed."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost

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


def brought(position: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the hand holds the block at the goal, from places alone; [N, 3] m and [3] m.

    For arms that cannot say what their fingers touch.
    """
    if position.shape[0] <= TARGET:
        raise InvalidInputError(f"position must be of a hand and a block, found {position.shape}")
    near = float(np.linalg.norm(position[TARGET] - goal)) <= GOAL_RADIUS
    return near and float(np.linalg.norm(position[TARGET] - position[HAND])) <= _HELD
