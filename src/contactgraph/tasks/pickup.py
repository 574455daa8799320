"""Pickup: a gripper picks up one target in a sweep and takes it to a goal, among bystanders."""

from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.tasks.box2d_world import SIMULATOR, CircleWorld
from contactgraph.tasks.contract import ChainCost, Observation
from contactgraph.tasks.pickup_layout import HALF_WIDTH, RADIUS, sample_layout

GRIPPER = 0
TARGET = 1
DT = 0.05
"""Time between two steps, s."""
MAX_STEPS = 200
MASS = 1.0
"""Of every body, kg."""
MAX_FORCE = 10.0
"""Bound of the control on each axis, N."""
MAX_DISTRACTORS = 20
GOAL_RADIUS = 0.1
"""The target must end within this distance of the goal, m."""


class PickupTask(gymnasium.Env[dict[str, Any], np.ndarray]):
    """The paper's first Box2D task; a `contactgraph.tasks.Task`.

    Nodes are the gripper (0), the target (1) and ``distractors`` further objects: circles that
    stick to whatever they touch. The control ``[2]`` N is a force on the gripper. The reward is
    the negative distance from target to goal, m. An episode always runs for 200 steps.

    Raises `InvalidInputError` where ``distractors`` is not in 0 to 20.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own declaration)
    max_steps = MAX_STEPS

    def __init__(self, distractors: int = 0, substeps: int = 10) -> None:
        if not 0 <= distractors <= MAX_DISTRACTORS:
            raise InvalidInputError(
                f"distractors must be 0 to {MAX_DISTRACTORS}, found {distractors}"
            )
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        self._distractors = distractors
        self._substeps = substeps
        self._count = 2 + distractors
        self.action_space = gymnasium.spaces.Box(-MAX_FORCE, MAX_FORCE, (2,), np.float64)
        self.observation_space = _observation_space(self._count)
        self._steps = 0
        self._goal = np.zeros(2)
        self._scene: Scene | None = None
        self._world: CircleWorld | None = None

    @property
    def scene(self) -> Scene:
        """The current episode's scene; its ``metadata["seed"]`` samples it again."""
        if self._scene is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._scene

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Samples a scene; everything starts at rest."""
        super().reset(seed=seed)
        # Every episode has a seed of its own, also one that follows another without being given.
        layout_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        layout = sample_layout(np.random.default_rng(layout_seed), self._distractors)
        mass, radius = np.full(self._count, MASS), np.full(self._count, RADIUS)
        world = CircleWorld(layout.position, mass, radius, DT, self._substeps)
        names = tuple(f"distractor-{index}" for index in range(self._distractors))
        self._scene = Scene(
            node_name=("gripper", "target", *names),
            node_type=("gripper", *["object"] * (self._count - 1)),
            actuated=np.arange(self._count) == GRIPPER,
            dt=DT,
            goal=layout.goal,
            mass=mass,
            radius=radius,
            metadata={
                "task": "pickup",
                "seed": layout_seed,
                "distractors": self._distractors,
                "simulator": SIMULATOR,
                "substeps": self._substeps,
            },
        )
        self._steps, self._goal, self._world = 0, layout.goal, world
        return self._observation(world), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves on by 0.05 s under the force ``action`` ``[2]`` N, clipped to its bounds."""
        if self._world is None or self._steps >= MAX_STEPS:
            raise gymnasium.error.ResetNeeded("the episode is over or not begun: call reset()")
        force = np.zeros((self._count, 2))
        force[GRIPPER] = np.clip(action, -MAX_FORCE, MAX_FORCE)
        if not np.all(np.isfinite(force)):
            raise InvalidInputError(f"action must be finite, found {np.asarray(action).tolist()}")
        self._world.step(force)
        self._steps += 1
        observation = self._observation(self._world)
        reward = -_distance_to_goal(observation["position"], self._goal)
        return observation, reward, False, self._steps == MAX_STEPS, {"success": self.success()}

    def success(self) -> bool:
        """Whether the episode is over with the target within 0.1 m of the goal."""
        if self._world is None or self._steps < MAX_STEPS:
            return False
        return _distance_to_goal(self._world.position, self._goal) <= GOAL_RADIUS

    def cost_terms(self) -> ChainCost:
        """The paper's weights: gripper to target, target to goal."""
        return ChainCost(
            chain=(GRIPPER, TARGET),
            pick_weights=np.array([3.0, 3.0, 0.2, 0.2]),
            goal_weights=np.array([50.0, 50.0, 1.0, 1.0]),
            control_weight=0.01,
        )

    def _observation(self, world: CircleWorld) -> Observation:
        return {
            "position": world.position,
            "velocity": world.velocity,
            "contact": world.contact.astype(np.int8),
            "goal": self._goal.copy(),
        }


def pickup_success(trajectory: Trajectory) -> bool:
    """Whether a recorded pickup ends, in time, with its target within 0.1 m of the goal.

    Raises `InvalidInputError` where the scene has no goal or no target.
    """
    goal = trajectory.scene.goal
    if goal is None or trajectory.scene.node_count <= TARGET:
        raise InvalidInputError(
            f"a pickup needs a goal and a target as node {TARGET}, found goal {goal} and nodes "
            f"{list(trajectory.scene.node_name)}"
        )
    distance = _distance_to_goal(trajectory.position[-1], goal)
    return trajectory.steps <= MAX_STEPS and distance <= GOAL_RADIUS


def _distance_to_goal(position: np.ndarray, goal: np.ndarray) -> float:
    return float(np.linalg.norm(position[TARGET] - goal))


def _observation_space(count: int) -> gymnasium.spaces.Dict:
    # The farthest and fastest that the largest force can bring a body in one episode.
    duration = MAX_STEPS * DT
    speed = MAX_FORCE / MASS * duration
    distance = HALF_WIDTH + speed * duration
    return gymnasium.spaces.Dict(
        {
            "position": gymnasium.spaces.Box(-distance, distance, (count, 2), np.float64),
            "velocity": gymnasium.spaces.Box(-speed, speed, (count, 2), np.float64),
            "contact": gymnasium.spaces.MultiBinary((count, count)),
            "goal": gymnasium.spaces.Box(-HALF_WIDTH, HALF_WIDTH, (2,), np.float64),
        }
    )
