"""The scripted expert of the pickups: a plain controller that shows how the task is done."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.excitation import CorrelatedNoise
from contactgraph.envs.gripper_task import GRIPPER
from contactgraph.envs.multi_pickup import held

STIFFNESS = 5.0
"""Kp, N/m: on the way to a target for every body that moves, to the goal for every one held."""
FREE_DAMPING = 0.5 * np.sqrt(STIFFNESS)
"""On the way to the first target, N s/m."""
HOLDING_DAMPING = 1.0 * np.sqrt(STIFFNESS)
"""On the way to a further target, N s/m for every body that moves."""
GOAL_DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""On the way to the goal with one target, and across the way to a target, N s/m."""


class PickupExpert:
    """Picks up the targets without stopping: a PD controller with the paper's gains.

    It is lightly damped on the way to the next target, meets it at speed, and makes for the one
    after it, and in the end for the goal, from the moment of touch on. Motion *across* the way to
    a target is damped as strongly as on the way to the goal: with the light damping alone one run
    in ten swings past a target of 0.04 m under noise, and turns round.

    Gains grow with what is held, as far as the control's bounds allow, so that five targets and
    the way to the goal fit into one episode.

    ``noise`` N is the standard deviation of the force that is added on each axis, correlated over
    ``correlation_steps`` steps: without it every force would be a function of the state, and a
    mass could not be told from a drag.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._targets: list[int] = []

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no pickup."""
        targets = [i for i, name in enumerate(scene.node_name) if name.startswith("target")]
        if scene.goal is None or not targets or not scene.actuated[GRIPPER]:
            raise InvalidInputError(
                "a pickup expert needs a goal, an actuated node 0 and nodes named target..., found "
                f"nodes {list(scene.node_name)}"
            )
        self._targets = targets
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"][GRIPPER]
        carried = held(observation["contact"])
        due = [target for target in self._targets if target not in carried]
        if due:
            way = position[due[0]] - position[GRIPPER]
            along = way * (way @ velocity) / (way @ way)
            across = velocity - along
            damping = HOLDING_DAMPING if carried else FREE_DAMPING
            force = STIFFNESS * way - damping * along - GOAL_DAMPING * across
            force = (1 + len(carried)) * force
        else:
            # The damping is 4 sqrt(Kp) for any Kp: with five held it nears the critical one.
            way = observation["goal"] - position[self._targets[-1]]
            force = len(carried) * STIFFNESS * way
            force = force - np.sqrt(len(carried)) * GOAL_DAMPING * velocity
        return force + self._noise()
