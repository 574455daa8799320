"""A pickup in space by hand-written motion: a hand on an arm sweeps through a block and lifts it.

With a belief, parameters and plans such as a good model would have.
"""

import numpy as np

from contactgraph.data import Scene, Trajectory, pair_indices
from contactgraph.viz import SceneTrajectory

DT, STEPS, GRASP = 0.02, 100, 45
HAND, BLOCK, GOAL = [0.35, -0.3, 0.3], [0.5, -0.02, 0.05], [0.6, 0.3, 0.25]
BLOCK_SIZE = np.array([0.04, 0.04, 0.1])
UPPER, LOWER = 0.36, 0.42
"""Of the arm, m."""


def _smooth(start, end, steps):
    """[steps + 1, 3] m along a minimum-jerk path."""
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return start + (np.asarray(end) - start) * (10 * share**3 - 15 * share**4 + 6 * share**5)


def _arm(hand):
    """[8, 3] m: base, shoulder, elbow, wrist, palm, one finger, back, the other finger."""
    shoulder, wrist = np.array([0.0, 0.0, 0.33]), hand + np.array([0.0, 0.0, 0.2])
    way = wrist - shoulder
    reach = np.linalg.norm(way)
    along = (UPPER**2 - LOWER**2 + reach**2) / (2 * reach)
    level = np.array([way[0], way[1], 0.0]) / np.hypot(way[0], way[1])
    up = np.array([0.0, 0.0, 1.0])
    bend = np.cross(np.cross(way, up), way)
    bend /= np.linalg.norm(bend)
    elbow = shoulder + along * way / reach + np.sqrt(max(UPPER**2 - along**2, 0.0)) * bend
    aside = 0.03 * np.array([-level[1], level[0], 0.0])
    palm = hand + 0.06 * up
    return np.stack([np.zeros(3), shoulder, elbow, wrist, palm, hand + aside, palm, hand - aside])


def sweep_trajectory(distractors=2):
    """Records the hand, the block it takes, and distractors."""
    hand = np.concatenate([_smooth(HAND, BLOCK, GRASP), _smooth(BLOCK, GOAL, STEPS - GRASP)[1:]])
    block = np.tile(BLOCK, (STEPS + 1, 1))
    block[GRASP:] = hand[GRASP:]
    others = [[0.4 + 0.25 * (k % 2), 0.2 - 0.13 * k, 0.05] for k in range(distractors)]
    rest = np.broadcast_to(np.array(others).reshape(-1, 3), (STEPS + 1, distractors, 3))
    position = np.concatenate([hand[:, None], block[:, None], rest], axis=1)
    velocity = np.gradient(position, DT, axis=0)
    nodes = 2 + distractors
    contact = np.zeros((STEPS + 1, nodes, nodes), dtype=bool)
    contact[GRASP:, 0, 1] = contact[GRASP:, 1, 0] = True
    names = ("hand", "block", *(f"distractor-{k}" for k in range(distractors)))
    scene = Scene(
        node_name=names,
        node_type=("hand", *("block" for _ in range(nodes - 1))),
        actuated=np.arange(nodes) == 0,
        dt=DT,
        dimension=3,
        goal=np.array(GOAL),
        mass=np.array([4.0, *(0.4 for _ in range(nodes - 1))]),
        radius=np.array([0.025, *(0.02 for _ in range(nodes - 1))]),
        metadata={"goal_radius": 0.05},
        size=np.stack([np.full(3, np.nan), *(BLOCK_SIZE for _ in range(nodes - 1))]),
    )
    control = 4.0 * np.gradient(velocity[:, 0], DT, axis=0)[:-1]
    return Trajectory(
        scene, position, velocity, control, contact, np.stack([_arm(point) for point in hand])
    )


def sweep(name="Sweep", distractors=2, horizon=25):
    """The same with what a model might make of it."""
    recorded = sweep_trajectory(distractors)
    rng = np.random.default_rng(0)
    edges = pair_indices(2 + distractors)
    held = (np.arange(STEPS) >= GRASP - 1).astype(float)
    belief = np.abs(0.01 * rng.standard_normal((STEPS, len(edges))))
    belief[:, 0] = np.clip(held - belief[:, 0], 0.0, 1.0)
    inverse_mass = np.abs(0.004 * rng.standard_normal((STEPS, 2 + distractors, 3)))
    inverse_mass[:, 0] += 0.25 - 0.02 * held[:, None]
    inverse_mass[:, 1] += 0.23 * held[:, None]
    damping = np.abs(0.02 * rng.standard_normal(inverse_mass.shape))
    damping[GRASP - 1, :2] += 8.0
    # A table holds a resting block up, and no block down.
    stiffness = np.abs(0.02 * rng.standard_normal(inverse_mass.shape))
    stiffness[:, 1, 2] += 40.0 * (1.0 - held)
    ahead = np.minimum(np.arange(STEPS)[:, None] + np.arange(horizon + 1), STEPS)
    return SceneTrajectory(
        name,
        recorded,
        edges,
        belief,
        inverse_mass=inverse_mass,
        stiffness=stiffness,
        damping=damping,
        plan=recorded.position[ahead] + 0.0005 * rng.standard_normal((STEPS, horizon + 1, 1, 3)),
    )
