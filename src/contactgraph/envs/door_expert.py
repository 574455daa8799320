"""The scripted expert of the door: a plain controller that shows how the task is done."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.door import DOOR
from contactgraph.envs.excitation import CorrelatedNoise
from contactgraph.envs.gripper_task import GRIPPER

STIFFNESS = 5.0
"""Kp, N/m on the way to the door; on its turn N m/rad for every kg m^2."""
FREE_DAMPING = 1.0 * np.sqrt(STIFFNESS)
"""Along the way to the door, N s/m."""
ACROSS_DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""Across the way to the door, N s/m."""
TURN_DAMPING = 2.0 * np.sqrt(STIFFNESS)
"""N m s/rad for every kg m^2: critical. The paper's 4 sqrt(Kp) would not be there in time."""
_LEAST_LEVER = 0.1
"""m, assumed where the gripper is pinned closer to the hinge, lest the force be without bound."""


class DoorExpert:
    """Strikes the door at its middle, at speed, and turns it to the goal: two PD controllers.

    On the turn the torque is proportional to the moment of inertia of door and gripper about the
    hinge, so that every door takes the same time. ``noise`` N is the standard deviation of the
    force that is added on each axis, correlated over ``correlation_steps`` steps.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._hinge = np.zeros(2)
        self._mass = np.zeros(2)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` has no door."""
        hinged = scene.anchor is not None and scene.node_count > DOOR
        if scene.anchor is None or not hinged or not np.isfinite(scene.anchor[DOOR]).all():
            raise InvalidInputError(
                f"a door expert needs a node {DOOR} with an anchor, found nodes "
                f"{list(scene.node_name)} and anchor {scene.anchor}"
            )
        if scene.goal is None or scene.mass is None:
            raise InvalidInputError(
                f"a door expert needs a goal and masses, found {scene.goal} and {scene.mass}"
            )
        self._hinge, self._mass = scene.anchor[DOOR], scene.mass[[GRIPPER, DOOR]]
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"]
        if observation["contact"][GRIPPER, DOOR]:
            force = self._turn(position, velocity, observation["goal"])
        else:
            way = position[DOOR] - position[GRIPPER]
            along = way * (way @ velocity[GRIPPER]) / (way @ way)
            across = velocity[GRIPPER] - along
            force = STIFFNESS * way - FREE_DAMPING * along - ACROSS_DAMPING * across
        return force + self._noise()

    def _turn(self, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[2] N across the gripper's lever."""
        bar, aim = position[DOOR] - self._hinge, goal - self._hinge
        lever = position[GRIPPER] - self._hinge
        # A thin rod about its end: four thirds of m r^2, r from the hinge to the middle.
        inertia = self._mass @ [lever @ lever, 4.0 / 3.0 * (bar @ bar)]
        left = np.array([-bar[1], bar[0]])
        missing = np.arctan2(left @ aim, bar @ aim)
        rate = (left @ velocity[DOOR]) / (bar @ bar)
        torque = inertia * (STIFFNESS * missing - TURN_DAMPING * rate)
        arm = float(np.linalg.norm(lever))
        return torque / max(arm, _LEAST_LEVER) * np.array([-lever[1], lever[0]]) / arm
