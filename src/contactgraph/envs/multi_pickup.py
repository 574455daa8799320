"""Multi-pickup: a gripper picks up targets one after the other and takes them all to a goal."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene, joined
from contactgraph.envs.box2d.circle_world import CircleWorld
from contactgraph.envs.box2d.engine import SIMULATOR
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.fixed_goal import fixed_layout, fixed_metadata
from contactgraph.envs.gripper_task import GRIPPER, GripperTask
from contactgraph.envs.pickup import (
    CONTROL_WEIGHT,
    GOAL_WEIGHTS,
    MAX_DISTRACTORS,
    MAX_STEPS,
    PICK_WEIGHTS,
    at_goal,
    check_counts,
    circle_scene,
    circle_world,
)
from contactgraph.envs.pickup_layout import extent, sample_layout

MAX_OBJECTS = 5


class MultiPickupTask(GripperTask):
    """The paper's second Box2D task; a `contactgraph.envs.Task`.

    Nodes are the gripper (0), ``objects`` targets (1, 2, ...) in the order in which they are to
    be picked up, and ``distractors`` further objects: circles that stick to whatever they touch,
    so that what is held forms a growing group. The control ``[2]`` N is a force on the gripper.
    The reward is the negative distance from the last target to the goal, m. An episode always
    runs for 200 steps.

    ``fixed_seed`` is the seed of a scene whose targets and goal every episode shares, so that only
    gripper and distractors begin elsewhere; None: each episode has its own.

    Raises `InvalidInputError` where ``objects`` is not in 1 to 5 or ``distractors`` in 0 to 20.
    """

    def __init__(
        self,
        objects: int = 2,
        distractors: int = 0,
        substeps: int = 10,
        fixed_seed: int | None = None,
    ) -> None:
        if not 1 <= objects <= MAX_OBJECTS:
            raise InvalidInputError(f"objects must be 1 to {MAX_OBJECTS}, found {objects}")
        check_counts(distractors, substeps)
        super().__init__(1 + objects + distractors, MAX_STEPS, extent(objects))
        self._objects = objects
        self._distractors = distractors
        self._substeps = substeps
        self._fixed_seed = fixed_seed
        self._fixed = fixed_layout(
            fixed_seed, lambda rng: sample_layout(rng, objects, MAX_DISTRACTORS)
        )

    def begin(self, seed: int) -> tuple[Scene, CircleWorld]:
        """Samples the scene of a seed, with everything at rest."""
        rng = np.random.default_rng(seed)
        layout = sample_layout(rng, self._objects, self._distractors, self._fixed)
        names = tuple(f"target-{index}" for index in range(1, self._objects + 1))
        told: dict[str, str | int | float | bool] = {
            "task": "multi-pickup",
            "seed": seed,
            "objects": self._objects,
            "distractors": self._distractors,
            "simulator": SIMULATOR,
            "substeps": self._substeps,
            **fixed_metadata(self._fixed_seed),
        }
        return circle_scene(layout, names, told), circle_world(layout, self._substeps)

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether every target is joined to the gripper and the last within 0.1 m of the goal."""
        every = set(range(1, self._objects + 1))
        return every <= held(contact) and at_goal(position[self._objects], scene)

    def cost_terms(self) -> ChainCost:
        """The paper's weights: gripper to first target, first to second, ..., last to goal."""
        chain = tuple(range(GRIPPER, self._objects + 1))
        return ChainCost(chain, PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)


def held(contact: np.ndarray) -> set[int]:
    """The nodes joined to the gripper by ``contact`` ``[N, N]``, directly or through others."""
    together = joined(np.asarray(contact, dtype=bool)[None])[0, GRIPPER]
    return {int(node) for node in np.flatnonzero(together)} - {GRIPPER}
