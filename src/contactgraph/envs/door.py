"""Door: a gripper strikes a hinged door, is pinned to it, and turns it to a goal angle."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.box2d.door_world import DoorWorld
from contactgraph.envs.box2d.engine import SIMULATOR
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.door_layout import (
    DISTRACTOR_HALF_WIDTH,
    LENGTH,
    THICKNESS,
    middle,
    sample_layout,
)
from contactgraph.envs.fixed_goal import fixed_layout, fixed_metadata
from contactgraph.envs.gripper_task import DT, GRIPPER, MASS, GripperTask

DOOR = 1
MAX_STEPS = 120
DOOR_MASS = 4.0
"""kg."""
GRIPPER_RADIUS = 0.04
"""m."""
MAX_DISTRACTORS = 10
GOAL_RADIUS = 0.05
"""The door's middle must end within this distance of the goal, m: 0.1 rad."""


class DoorTask(GripperTask):
    """The paper's third Box2D task; a `contactgraph.envs.Task`.

    Nodes are the gripper (0), the target door (1) and ``distractors`` further doors. A door is a
    bar, 4 kg, 0.05 x 1.0 m, that turns freely about a hinge at one end (``scene.anchor``); its
    node is its middle. The gripper is pinned to the first door that it touches, where it touches
    it. The control ``[2]`` N is a force on the gripper. The reward is the negative distance of the
    door's middle from where it is at the goal angle, m. An episode always runs for 120 steps.

    ``fixed_seed`` is the seed of a scene whose target door (hinge, angle) and goal every episode
    shares, so that only the gripper and other doors begin elsewhere; None: each has its own.

    Raises `InvalidInputError` where ``distractors`` is not in 0 to 10.
    """

    def __init__(
        self, distractors: int = 0, substeps: int = 10, fixed_seed: int | None = None
    ) -> None:
        if not 0 <= distractors <= MAX_DISTRACTORS:
            raise InvalidInputError(
                f"distractors must be 0 to {MAX_DISTRACTORS}, found {distractors}"
            )
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        super().__init__(2 + distractors, MAX_STEPS, DISTRACTOR_HALF_WIDTH + LENGTH)
        self._distractors = distractors
        self._substeps = substeps
        self._fixed_seed = fixed_seed
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_DISTRACTORS))

    def begin(self, seed: int) -> tuple[Scene, DoorWorld]:
        """Samples the scene of a seed, with everything at rest."""
        layout = sample_layout(np.random.default_rng(seed), self._distractors, self._fixed)
        world = DoorWorld(
            layout.gripper,
            layout.hinge,
            layout.angle,
            gripper_mass=MASS,
            gripper_radius=GRIPPER_RADIUS,
            door_mass=DOOR_MASS,
            length=LENGTH,
            thickness=THICKNESS,
            dt=DT,
            substeps=self._substeps,
        )
        doors = 1 + self._distractors
        scene = Scene(
            node_name=("gripper", "door", *(f"distractor-{i}" for i in range(self._distractors))),
            node_type=("gripper", *["door"] * doors),
            actuated=np.arange(1 + doors) == GRIPPER,
            dt=DT,
            anchor=np.vstack([[np.nan, np.nan], layout.hinge]),
            goal=middle(layout.hinge[0], layout.goal_angle),
            mass=np.array([MASS, *[DOOR_MASS] * doors]),
            radius=np.array([GRIPPER_RADIUS, *[0.5 * THICKNESS] * doors]),
            candidate_edges=np.array([[GRIPPER, door] for door in range(DOOR, DOOR + doors)]),
            metadata={
                "task": "door",
                "seed": seed,
                "distractors": self._distractors,
                "simulator": SIMULATOR,
                "substeps": self._substeps,
                "angle": float(layout.angle[0]),
                "goal_angle": layout.goal_angle,
                **fixed_metadata(self._fixed_seed),
            },
        )
        return scene, world

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the gripper is at the door, and its middle within 0.05 m of the goal."""
        distance = float(np.linalg.norm(position[DOOR] - scene.goal))
        return bool(contact[GRIPPER, DOOR]) and distance <= GOAL_RADIUS

    def cost_terms(self) -> ChainCost:
        """Gripper to door with the paper's weights, door to goal with those of pickup.

        The paper's own, 1 and 2, leave the door 3 to 25 cm from its goal when the time is over.
        """
        return ChainCost(
            chain=(GRIPPER, DOOR),
            pick_weights=np.array([6.5, 6.5, 0.2, 0.2]),
            goal_weights=np.array([50.0, 50.0, 1.0, 1.0]),
            control_weight=0.01,
        )
