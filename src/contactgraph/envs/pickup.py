"""The pickup tasks: a gripper takes one or several targets to a goal."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene, Trajectory, joined
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.grip import HoldAtTouch
from contactgraph.envs.gripper_task import (
    DT,
    GRIPPER,
    MASS,
    GripperTask,
    fixed_layout,
    fixed_metadata,
)
from contactgraph.envs.pickup_layout import (
    HALF_WIDTH,
    IN_THE_WAY,
    RADIUS,
    PickupLayout,
    extent,
    sample_layout,
)
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_world import SIMULATOR, PlanarWorld

TARGET = 1
MAX_STEPS = 200
MAX_DISTRACTORS = 20
MAX_RADIUS = 0.06
"""Largest radius of a body, m: larger bodies would overlap in dense scenes."""
GOAL_RADIUS = 0.1
"""The target must end within this distance of the goal, m."""
PICK_WEIGHTS = np.array([3.0, 3.0, 0.2, 0.2])
GOAL_WEIGHTS = np.array([50.0, 50.0, 1.0, 1.0])
CONTROL_WEIGHT = 0.01


class PickupTask(GripperTask):
    """The paper's first Box2D task; a `contactgraph.envs.Task`.

    Nodes are the gripper (0), the target (1) and ``distractors`` further objects: circles that
    stick to all that they touch. The control ``[2]`` N is a force on the gripper. The reward is
    the negative distance from target to goal, m. An episode always runs for 200 steps.

    ``fixed_seed`` is the seed of a scene whose target and goal every episode shares, so that only
    the start of gripper and distractors varies; None: each episode has its own.

    ``radius`` m is every body's. ``in_the_way``: a straight way to the target and to the goal
    touches two distractors or more. Raises `InvalidInputError` where ``distractors`` is not in 0 to
    20, or 2 to 20 in the way, or the radius not above 0 and at most 0.06 m.
    """

    def __init__(
        self,
        distractors: int = 0,
        substeps: int = 10,
        fixed_seed: int | None = None,
        radius: float = RADIUS,
        in_the_way: bool = False,
    ) -> None:
        check_counts(distractors, substeps)
        if in_the_way and distractors < IN_THE_WAY:
            raise InvalidInputError(
                f"distractors must be {IN_THE_WAY} or more to be in the way, found {distractors}"
            )
        if not 0.0 < radius <= MAX_RADIUS:
            raise InvalidInputError(f"radius must be above 0, to {MAX_RADIUS} m, found {radius}")
        super().__init__(2 + distractors, MAX_STEPS, HALF_WIDTH)
        self._distractors = distractors
        self._substeps = substeps
        self._fixed_seed = fixed_seed
        self._radius = radius
        self._in_the_way = in_the_way
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, 1, MAX_DISTRACTORS))

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        rng = np.random.default_rng(seed)
        layout = sample_layout(rng, 1, self._distractors, self._fixed, self._in_the_way)
        metadata: dict[str, str | int | float | bool] = {
            "task": "pickup",
            "seed": seed,
            "distractors": self._distractors,
            "simulator": SIMULATOR,
            "substeps": self._substeps,
            **fixed_metadata(self._fixed_seed),
        }
        if self._in_the_way:
            metadata["in_the_way"] = True
        scene = disc_scene(layout, ("target",), metadata, self._radius)
        return scene, disc_world(layout, self._substeps, self._radius)

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the target is within 0.1 m of the goal."""
        return at_goal(position[TARGET], scene)

    def cost_terms(self) -> ChainCost:
        """The paper's weights: gripper to target, target to goal."""
        return ChainCost((GRIPPER, TARGET), PICK_WEIGHTS, GOAL_WEIGHTS, CONTROL_WEIGHT)


def check_counts(distractors: int, substeps: int) -> None:
    """Raises `InvalidInputError` for counts that no pickup has."""
    if not 0 <= distractors <= MAX_DISTRACTORS:
        raise InvalidInputError(f"distractors must be 0 to {MAX_DISTRACTORS}, found {distractors}")
    if substeps < 1:
        raise InvalidInputError(f"substeps must be at least 1, found {substeps}")


def disc_scene(
    layout: PickupLayout,
    targets: tuple[str, ...],
    metadata: dict[str, str | int | float | bool],
    size: float = RADIUS,
) -> Scene:
    """The scene of a layout whose targets have these names; ``size`` m is every body's radius."""
    count = len(layout.position)
    distractors = tuple(f"distractor-{index}" for index in range(len(layout.distractors)))
    return Scene(
        node_name=("gripper", *targets, *distractors),
        node_type=("gripper", *["object"] * (count - 1)),
        actuated=np.arange(count) == GRIPPER,
        dt=DT,
        goal=layout.goal,
        mass=np.full(count, MASS),
        radius=np.full(count, size),
        metadata=metadata,
    )


def disc_world(layout: PickupLayout, substeps: int, size: float = RADIUS) -> PlanarWorld:
    """The world of a layout; ``size`` m is the radius of every body."""
    bodies = [PlanarBody(position, MASS, radius=size) for position in layout.position]
    return PlanarWorld(bodies, DT, substeps, HoldAtTouch())


def at_goal(position: np.ndarray, scene: Scene) -> bool:
    """Whether ``position`` ``[2]`` m is within 0.1 m of the goal."""
    return float(np.linalg.norm(position - scene.goal)) <= GOAL_RADIUS


def pickup_success(trajectory: Trajectory) -> bool:
    """Whether a recorded pickup ends, in time, with its target within 0.1 m of the goal.

    Raises `InvalidInputError` where the scene has no goal or no target.
    """
    scene = trajectory.scene
    if scene.goal is None or scene.node_count <= TARGET:
        raise InvalidInputError(
            f"a pickup needs a goal and a target as node {TARGET}, found goal {scene.goal} and "
            f"nodes {list(scene.node_name)}"
        )
    return trajectory.steps <= MAX_STEPS and at_goal(trajectory.position[-1, TARGET], scene)


MAX_OBJECTS = 5


class MultiPickupTask(GripperTask):
    """The paper's second Box2D task; a `contactgraph.envs.Task`.

    Nodes are the gripper (0), ``objects`` targets (1, 2, ...) in the order in which they are to
    be picked up, and ``distractors`` further objects: circles that stick to all that they touch,
    so that the grasped bodies form a growing group. The control ``[2]`` N is a force on the
    gripper. The reward is the negative distance from the last target to the goal, m. An episode
    always runs for 200 steps.

    ``fixed_seed`` is the seed of a scene whose targets and goal every episode shares, so that only
    the start of gripper and distractors varies; None: each episode has its own.

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

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        rng = np.random.default_rng(seed)
        layout = sample_layout(rng, self._objects, self._distractors, self._fixed)
        names = tuple(f"target-{index}" for index in range(1, self._objects + 1))
        metadata: dict[str, str | int | float | bool] = {
            "task": "multi-pickup",
            "seed": seed,
            "objects": self._objects,
            "distractors": self._distractors,
            "simulator": SIMULATOR,
            "substeps": self._substeps,
            **fixed_metadata(self._fixed_seed),
        }
        return disc_scene(layout, names, metadata), disc_world(layout, self._substeps)

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
