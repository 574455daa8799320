"""Scripted experts: plain controllers that show how a task is done."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.tasks.contract import Observation
from contactgraph.tasks.excitation import CorrelatedNoise
from contactgraph.tasks.pickup import GRIPPER, TARGET

STIFFNESS = 5.0
"""Kp, N/m."""
FREE_DAMPING = 0.5 * np.sqrt(STIFFNESS)
"""On the way to the target, N s/m."""
GOAL_DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""On the way to the goal, and across the way to the target, N s/m."""


class PickupExpert:
    """Picks up the target without stopping: a PD controller with the paper's gains.

    It is lightly damped on the way to the target, meets it at speed, and makes for the goal from
    the moment of touch on. Motion *across* the way to the target is damped as strongly as later
    on: with the light damping alone one run in ten swings past a target of 0.04 m under noise,
    and turns round.

    ``noise`` N is the standard deviation of the force that is added on each axis, correlated over
    ``correlation_steps`` steps: without it every force would be a function of the state, and a
    mass could not be told from a drag.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no pickup."""
        if scene.goal is None or scene.node_count < 2 or not scene.actuated[GRIPPER]:
            raise InvalidInputError(
                "a pickup expert needs a goal, an actuated node 0 and a target as node 1, found "
                f"nodes {list(scene.node_name)}"
            )
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"][GRIPPER]
        if observation["contact"][GRIPPER, TARGET]:
            force = STIFFNESS * (observation["goal"] - position[TARGET]) - GOAL_DAMPING * velocity
        else:
            way = position[TARGET] - position[GRIPPER]
            along = way * (way @ velocity) / (way @ way)
            across = velocity - along
            force = STIFFNESS * way - FREE_DAMPING * along - GOAL_DAMPING * across
        return force + self._noise()
