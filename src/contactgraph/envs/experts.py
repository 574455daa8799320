"""Scripted policies: experts for pickups and door, exploration and rest."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation
from contactgraph.envs.door import DOOR
from contactgraph.envs.gripper_task import GRIPPER
from contactgraph.envs.pickup import held


class CorrelatedNoise:
    """An Ornstein-Uhlenbeck process, stationary from its first value on.

    ``deviation`` N is the standard deviation on each axis; after ``correlation_steps`` steps the
    correlation has fallen to 1/e.
    """

    def __init__(self, deviation: float, correlation_steps: float) -> None:
        if not (deviation >= 0.0 and correlation_steps > 0.0):
            raise InvalidInputError(
                f"noise needs deviation >= 0 and correlation_steps > 0, found "
                f"{deviation} and {correlation_steps}"
            )
        self._deviation = deviation
        self._keep = float(np.exp(-1.0 / correlation_steps))
        self._rng = np.random.default_rng(0)
        self._value = np.zeros(0)

    def reset(self, size: int, seed: int) -> None:
        """Restarts the process with ``size`` axes."""
        self._rng = np.random.default_rng(seed)
        self._value = self._deviation * self._rng.standard_normal(size)

    def __call__(self) -> np.ndarray:
        """The next value, ``[size]`` N."""
        value = self._value
        fresh = self._deviation * self._rng.standard_normal(value.shape)
        self._value = self._keep * value + np.sqrt(1.0 - self._keep**2) * fresh
        return value


class ExplorationPolicy:
    """Random forces that keep the gripper in the scene; it sometimes collides.

    A spring (``stiffness`` N/m) to the mean start position of nodes and goal and a damper
    (``damping`` N s/m) keep it near the scene. The defaults are for 1 kg and steps of
    0.05 s: its position spreads by 0.6 m on each axis, and it hits a lone target in one episode of
    three.
    """

    def __init__(
        self,
        deviation: float = 2.0,
        correlation_steps: float = 5.0,
        stiffness: float = 3.0,
        damping: float = 0.7,
    ) -> None:
        self._noise = CorrelatedNoise(deviation, correlation_steps)
        self._stiffness, self._damping = stiffness, damping
        self._actuated = 0
        self._home: np.ndarray | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._actuated = int(np.argmax(scene.actuated))
        self._home = None
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[D]`` N."""
        if self._home is None:
            positions = np.concatenate([observation["position"], observation["goal"][None]])
            self._home = (positions.min(axis=0) + positions.max(axis=0)) / 2.0
        away = observation["position"][self._actuated] - self._home
        velocity = observation["velocity"][self._actuated]
        return self._noise() - self._stiffness * away - self._damping * velocity


class RestPolicy:
    """Does nothing: zero force, or the target where the actuated body is."""

    def __init__(self) -> None:
        self._scene: Scene | None = None

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._scene = scene

    def __call__(self, observation: Observation) -> np.ndarray:
        """Zeros ``[U]``, but for targets in the world: there the position of their node, m."""
        assert self._scene is not None, "call reset() first"
        kinds, acts = self._scene.control_kind, self._scene.control_of
        if kinds is None:
            return np.zeros(self._scene.dimension)
        control = np.zeros(len(kinds))
        if "position" in kinds:
            targets = [index for index, kind in enumerate(kinds) if kind == "position"]
            moved = self._scene.actuated if acts is None else acts[:, targets].any(axis=1)
            control[targets] = observation["position"][int(moved.argmax())][: len(targets)]
        return control


STIFFNESS = 5.0
"""Kp, N/m: per moving body towards a target, per grasped body towards the goal."""
FREE_DAMPING = 0.5 * np.sqrt(STIFFNESS)
"""Towards the first target, N s/m."""
HOLDING_DAMPING = 1.0 * np.sqrt(STIFFNESS)
"""Towards a further target, N s/m for every body that moves."""
GOAL_DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""Towards the goal with one target, and across the direction to a target, N s/m."""


def carried_targets(scene: Scene) -> list[int]:
    """The nodes named target...; raises `InvalidInputError` where nothing is to be carried."""
    targets = [i for i, name in enumerate(scene.node_name) if name.startswith("target")]
    if scene.goal is None or not targets or not scene.actuated[GRIPPER]:
        raise InvalidInputError(
            "this expert needs a goal, an actuated node 0 and nodes named target..., found "
            f"nodes {list(scene.node_name)}"
        )
    return targets


class PickupExpert:
    """Picks up the targets without stopping: a PD controller with the paper's gains.

    Motion towards the next target is lightly damped, so that the gripper meets it at speed and
    continues to the next one, and in the end to the goal. Motion *across* that direction is damped
    as strongly as motion to the goal: with light damping alone one episode in ten swings past a
    target of 0.04 m under noise and turns round.

    Gains grow with the grasped mass, within the control's bounds, so that five targets and the goal
    fit into one episode.

    ``noise`` N is the standard deviation of a force added on each axis, correlated over
    ``correlation_steps`` steps. Without it every force would be a function of the state, and mass
    could not be distinguished from drag.
    """

    def __init__(self, noise: float = 0.5, correlation_steps: float = 2.0) -> None:
        self._noise = CorrelatedNoise(noise, correlation_steps)
        self._targets: list[int] = []

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no pickup."""
        self._targets = carried_targets(scene)
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"][GRIPPER]
        grasped = held(observation["contact"])
        due = [target for target in self._targets if target not in grasped]
        if due:
            offset = position[due[0]] - position[GRIPPER]
            along = offset * (offset @ velocity) / (offset @ offset)
            across = velocity - along
            damping = HOLDING_DAMPING if grasped else FREE_DAMPING
            force = STIFFNESS * offset - damping * along - GOAL_DAMPING * across
            force = (1 + len(grasped)) * force
        else:
            # The damping is 4 sqrt(Kp) for any Kp: with five held it nears the critical one.
            offset = observation["goal"] - position[self._targets[-1]]
            force = len(grasped) * STIFFNESS * offset
            force = force - np.sqrt(len(grasped)) * GOAL_DAMPING * velocity
        return force + self._noise()


DOOR_STIFFNESS = 5.0
"""Kp, N/m towards the door; while turning N m/rad per kg m^2."""
DOOR_FREE_DAMPING = 1.0 * np.sqrt(DOOR_STIFFNESS)
"""Along the direction to the door, N s/m."""
ACROSS_DAMPING = 4.0 * np.sqrt(DOOR_STIFFNESS)
"""Across the direction to the door, N s/m."""
TURN_DAMPING = 2.0 * np.sqrt(DOOR_STIFFNESS)
"""N m s/rad per kg m^2: critical. The paper's 4 sqrt(Kp) would be too slow."""
_LEAST_RADIUS = 0.1
"""m; the least assumed distance of the gripper to the hinge, which bounds the force."""


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
        hinged = scene.node_count > DOOR and scene.hinged[DOOR]
        if not hinged or scene.goal is None or scene.mass is None:
            raise InvalidInputError(
                f"a door expert needs a node {DOOR} with an anchor, a goal and masses, found nodes "
                f"{list(scene.node_name)} and anchor {scene.anchor.tolist()}"
            )
        self._hinge, self._mass = scene.anchor[DOOR], scene.mass[[GRIPPER, DOOR]]
        self._noise.reset(scene.dimension, seed)

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[2]`` N."""
        position, velocity = observation["position"], observation["velocity"]
        if observation["contact"][GRIPPER, DOOR]:
            force = self._turn(position, velocity, observation["goal"])
        else:
            offset = position[DOOR] - position[GRIPPER]
            along = offset * (offset @ velocity[GRIPPER]) / (offset @ offset)
            across = velocity[GRIPPER] - along
            force = DOOR_STIFFNESS * offset - DOOR_FREE_DAMPING * along - ACROSS_DAMPING * across
        return force + self._noise()

    def _turn(self, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[2] N perpendicular to the gripper's radius vector."""
        bar, aim = position[DOOR] - self._hinge, goal - self._hinge
        radius_vector = position[GRIPPER] - self._hinge
        # A thin rod about its end: four thirds of m r^2, r from the hinge to the middle.
        inertia = self._mass @ [radius_vector @ radius_vector, 4.0 / 3.0 * (bar @ bar)]
        left = np.array([-bar[1], bar[0]])
        missing = np.arctan2(left @ aim, bar @ aim)
        rate = (left @ velocity[DOOR]) / (bar @ bar)
        torque = inertia * (DOOR_STIFFNESS * missing - TURN_DAMPING * rate)
        radius = float(np.linalg.norm(radius_vector))
        across = np.array([-radius_vector[1], radius_vector[0]])
        return torque / max(radius, _LEAST_RADIUS) * across / radius
