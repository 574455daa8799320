"""The base of tasks in which a force moves a gripper: episodes, observations, rewards."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeVar, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Observation

GRIPPER = 0
DT = 0.05
"""Time between two steps, s."""
MASS = 1.0
"""Of the gripper, kg."""
MAX_FORCE = 10.0
"""Bound of the control on each axis, N."""
PICK_WEIGHTS = np.array([3.0, 3.0, 0.2, 0.2])
GOAL_WEIGHTS = np.array([50.0, 50.0, 1.0, 1.0])
CONTROL_WEIGHT = 0.01
_MOST_TURN = 1e3
"""rad, rad/s: bound of an observed angle and rate."""


class World(Protocol):
    """``N`` bodies that move under forces and stick together once they touch."""

    @property
    def metadata(self) -> Mapping[str, Any]:
        """Of every scene with such a world: the simulator, and how it is used."""

    @property
    def position(self) -> np.ndarray:
        """``[N, D]`` m."""

    @property
    def velocity(self) -> np.ndarray:
        """``[N, D]`` m/s."""

    @property
    def contact(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric."""

    def step(self, force: np.ndarray) -> None:
        """Advances by a time step under a constant ``force`` ``[N, D]`` N."""


class GripperTask(gymnasium.Env[dict[str, Any], np.ndarray], ABC):
    """A gripper (node 0) that forces move among ``count - 1`` other bodies.

    The control ``[D]`` N is a force on the gripper. The reward is the negative distance, m, from
    the last node of the cost's chain, or the nearest candidate for it, to the goal. An episode
    always runs for ``max_steps`` steps. ``extent`` m bounds the start positions and the goal on
    each axis; ``mass`` kg is the gripper's. ``fixed_seed`` is that of the `fixed_layout` of a
    subclass.

    A subclass defines the start of an episode and, where they differ, its cost and its success.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)
    name: str
    """Of the task, for the metadata of scenes; the class's name where it is not given."""
    max_force: float | None = MAX_FORCE
    """Bound of the control on each axis, N. None: a subclass has another bound."""
    passive = False
    """Whether nothing is driven, and the control is empty."""
    chain: tuple[int, ...] = (GRIPPER, 1)
    """Nodes that the cost ties together, the last of them to the goal: see `ChainCost`."""
    goal_radius = 0.1
    """The last node of the cost's chain must end within this distance of the goal, m."""
    observes_holding = False
    """Whether observations have the key ``holding``, beside contacts: touching or holding."""
    observes_turning = False
    """Whether observations have the keys ``orientation`` and ``angular_velocity``."""

    def __init__(
        self,
        count: int,
        max_steps: int,
        extent: float,
        *,
        dimension: int = 2,
        dt: float = DT,
        mass: float = MASS,
        fixed_seed: int | None = None,
    ) -> None:
        self.max_steps = max_steps
        size = 0 if self.passive else dimension
        max_force = MAX_FORCE if self.max_force is None else self.max_force
        bounds = gymnasium.spaces.Box(-max_force, max_force, (size,), np.float64)
        self.action_space = bounds
        # The largest distance and speed that the largest force gives a body in one episode.
        speed = max_force / mass * max_steps * dt
        distance = extent + speed * max_steps * dt
        turning = (_MOST_TURN, _MOST_TURN) if self.observes_turning else None
        space = observation_space(count, dimension, extent, distance, speed, turning)
        if self.observes_holding:
            space.spaces["holding"] = space.spaces["contact"]
        self.observation_space = space
        self._shape = count, dimension
        self._pushed: np.ndarray = np.zeros(self._shape)
        self._steps = 0
        self._fixed_metadata = {} if fixed_seed is None else {"fixed_seed": fixed_seed}
        self._episode: tuple[Scene, World] | None = None

    @abstractmethod
    def begin(self, seed: int) -> tuple[Scene, World]:
        """Samples the scene of a seed; where something is driven, with everything at rest.

        Its metadata gain the task's name, the world's, and the seeds that reproduce it.
        """

    def cost_terms(self) -> ChainCost:
        """The task as a cost: along the `chain`, with the weights of the paper's pickups."""
        return ChainCost(self.chain, PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)

    @property
    def scene(self) -> Scene:
        """The current episode's scene; its ``metadata["seed"]`` samples it again."""
        return self._begun()[0]

    @property
    def world(self) -> World:
        """The current episode's world."""
        return self._begun()[1]

    def _begun(self) -> tuple[Scene, World]:
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Samples a scene."""
        super().reset(seed=seed)
        # Every episode has a seed, also if none is given.
        scene_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        scene, world = self.begin(scene_seed)
        named = {"task": getattr(self, "name", type(self).__name__), **world.metadata}
        metadata = {**named, **scene.metadata, "seed": scene_seed, **self._fixed_metadata}
        self._steps, self._episode = 0, (replace(scene, metadata=metadata), world)
        self._pushed = np.zeros(self._shape)
        return self.observed(), {}

    def observed(self) -> Observation:
        """The observation of the present state."""
        scene, world = self._begun()
        observation = {
            "position": world.position,
            "velocity": world.velocity,
            "contact": world.contact.astype(np.int8),
            "goal": np.array(scene.goal),
        }
        of_world = cast(Any, world)
        if self.observes_holding:
            observation["holding"] = of_world.holding.astype(np.int8)
        if self.observes_turning:
            observation["orientation"] = of_world.angle[:, None]
            observation["angular_velocity"] = of_world.angular_velocity[:, None]
        return observation

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by ``scene.dt`` under the force ``action`` ``[D]`` N, clipped to its bounds."""
        force = self.disturbance()
        # A further component, such as a switch, moves nothing by itself.
        driving = self.bounded(action)[: self._shape[1]]
        force[GRIPPER, : len(driving)] += driving
        self.running().step(force)
        return self.stepped({})

    def move_goal(self, goal: np.ndarray) -> None:
        """See `contactgraph.envs.contract.DisturbableTask`; raises `InvalidInputError`."""
        scene, world = self.scene, self.world
        self._episode = replace(scene, goal=_checked("goal", goal, self._shape[1:])), world

    def disturb(self, force: np.ndarray) -> None:
        """See `contactgraph.envs.contract.DisturbableTask`; raises `InvalidInputError`."""
        self._pushed = self._pushed + _checked("force", force, self._shape)

    def disturbance(self) -> np.ndarray:
        """[N, D] N: the forces of `disturb` for the coming step, which takes them."""
        force, self._pushed = self._pushed, np.zeros(self._shape)
        return force

    def bounded(self, action: np.ndarray) -> np.ndarray:
        """The control ``[U]`` within its bounds; raises `InvalidInputError` for no number."""
        box = cast(gymnasium.spaces.Box, self.action_space)
        force = np.clip(action, box.low, box.high)
        if not np.all(np.isfinite(force)):
            raise InvalidInputError(f"action must be finite, found {np.asarray(action).tolist()}")
        return force

    def running(self) -> World:
        """The current episode's world, if the episode is not over."""
        if self._episode is None or self._steps >= self.max_steps:
            raise gymnasium.error.ResetNeeded("the episode is over or not begun: call reset()")
        return self._episode[1]

    def stepped(
        self, info: dict[str, Any]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """The return value of `step` once the world has advanced; ``info`` is added to it."""
        self._steps += 1
        observation = self.observed()
        position, goal = observation["position"], observation["goal"]
        last = self.cost_terms().ending_nearest(position, goal)[-1]
        reward = -float(np.linalg.norm(position[last] - goal))
        over = self._steps == self.max_steps
        return observation, reward, False, over, {"success": self.success(), **info}

    def success(self) -> bool:
        """Whether the episode is over and has ended as the task demands."""
        if self._episode is None or self._steps < self.max_steps:
            return False
        scene, world = self._episode
        return self.solved(scene, world.position, world.contact)

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether an episode that ends so, ``[N, D]`` m and ``[N, N]`` bool, is a success."""
        last = position[self.cost_terms().chain[-1]]
        return float(np.linalg.norm(last - scene.goal)) <= self.goal_radius


def _checked(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InvalidInputError(f"{name} must be finite of shape {shape}, found {array.tolist()}")
    return array.copy()


def observation_space(
    count: int,
    dimension: int,
    extent: float,
    distance: float,
    speed: float,
    turning: tuple[float, float] | None = None,
) -> gymnasium.spaces.Dict:
    """That of an `Observation`, with bounds of goal, position, velocity, and of angle and rate."""

    def box(most: float, *shape: int) -> gymnasium.spaces.Box:
        return gymnasium.spaces.Box(-most, most, shape, np.float64)

    spaces: dict[str, gymnasium.spaces.Space[Any]] = {
        "position": box(distance, count, dimension),
        "velocity": box(speed, count, dimension),
        "contact": gymnasium.spaces.MultiBinary((count, count)),
        "goal": box(extent, dimension),
    }
    if turning is not None:
        spaces["orientation"] = box(turning[0], count, 1 if dimension == 2 else 4)
        spaces["angular_velocity"] = box(turning[1], count, 1 if dimension == 2 else 3)
    return gymnasium.spaces.Dict(spaces)


Layout = TypeVar("Layout")


def fixed_layout(
    fixed_seed: int | None, sample: Callable[[np.random.Generator], Layout]
) -> Layout | None:
    """The layout whose targets and goal all episodes share; None: each episode has its own.

    ``sample`` should place the largest number of distractors: then targets and goal leave space
    for any number of them and do not depend on it. Raises `InvalidInputError`
    where the seed is negative.
    """
    if fixed_seed is None:
        return None
    if fixed_seed < 0:
        raise InvalidInputError(f"fixed_seed must be at least 0, found {fixed_seed}")
    return sample(np.random.default_rng(fixed_seed))


def check_count(name: str, count: int, least: int, most: int) -> None:
    """Raises `InvalidInputError` where a task cannot have so many bodies."""
    if not least <= count <= most:
        raise InvalidInputError(f"{name} must be {least} to {most}, found {count}")
