"""Tasks in which a gripper carries discs: their base, and the paper's two pickups."""

import numpy as np

from contactgraph.data import InvalidInputError, Scene, joined
from contactgraph.envs.contract import Conditions, Observation
from contactgraph.envs.exploration import NoisyPolicy
from contactgraph.envs.grip import HoldAtTouch
from contactgraph.envs.gripper_task import (
    DT,
    GRIPPER,
    MASS,
    GripperTask,
    check_count,
    fixed_layout,
)
from contactgraph.envs.pickup_layout import IN_THE_WAY, RADIUS, extent, sample_layout
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import HoldRule, PlanarWorld

TARGET = 1
MAX_DISTRACTORS = 20
MAX_OBJECTS = 5
MAX_RADIUS = 0.06
"""Largest radius of a body, m: larger bodies would overlap in dense scenes."""

Metadata = dict[str, str | int | float | bool]


def held(contact: np.ndarray) -> set[int]:
    """The nodes joined to the gripper by ``contact`` ``[N, N]``, directly or through others."""
    together = joined(np.asarray(contact, dtype=bool)[None])[0, GRIPPER]
    return {int(node) for node in np.flatnonzero(together)} - {GRIPPER}


STIFFNESS = 5.0
"""Kp, N/m: per moving body towards a target, per grasped body towards the goal."""
FREE_DAMPING = 0.5 * np.sqrt(STIFFNESS)
"""Towards the first target, N s/m."""
HOLDING_DAMPING = 1.0 * np.sqrt(STIFFNESS)
"""Towards a further target, N s/m for every body that moves."""
GOAL_DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""Towards the goal with one target, and across the direction to a target, N s/m."""


def pd_force(offset: np.ndarray, velocity: np.ndarray, damping: float) -> np.ndarray:
    """``[2]`` N of a PD controller towards a point at ``offset`` ``[2]`` m, at ``velocity`` m/s.

    ``damping`` N s/m is that along the way; across it, it is `GOAL_DAMPING`.
    """
    along = offset * (offset @ velocity) / (offset @ offset)
    return STIFFNESS * offset - damping * along - GOAL_DAMPING * (velocity - along)


def carried_targets(scene: Scene) -> list[int]:
    """The nodes named target...; raises `InvalidInputError` where nothing is to be carried."""
    targets = [i for i, name in enumerate(scene.node_name) if name.startswith("target")]
    if scene.goal is None or not targets or not scene.actuated[GRIPPER]:
        raise InvalidInputError(
            "this expert needs a goal, an actuated node 0 and nodes named target..., found "
            f"nodes {list(scene.node_name)}"
        )
    return targets


class PickupExpert(NoisyPolicy):
    """Picks up the targets without stopping: a PD controller with the paper's gains.

    Motion towards the next target is lightly damped, so that the gripper meets it at speed and
    continues to the next one, and in the end to the goal. Motion *across* that direction is damped
    as strongly as motion to the goal: with light damping alone one episode in ten swings past a
    target of 0.04 m under noise and turns round.

    Gains grow with the grasped mass, within the control's bounds, so that five targets and the goal
    fit into one episode.
    """

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no pickup."""
        self._targets = carried_targets(scene)
        super().reset(scene, seed)

    def _force(self, observation: Observation) -> np.ndarray:
        """``[2]`` N, without the noise."""
        position, velocity = observation["position"], observation["velocity"][GRIPPER]
        grasped = held(observation["contact"])
        due = [target for target in self._targets if target not in grasped]
        if due:
            damping = HOLDING_DAMPING if grasped else FREE_DAMPING
            force = pd_force(position[due[0]] - position[GRIPPER], velocity, damping)
            return (1 + len(grasped)) * force
        # The damping is 4 sqrt(Kp) for any Kp: with five held it nears the critical one.
        offset = observation["goal"] - position[self._targets[-1]]
        force = len(grasped) * STIFFNESS * offset
        return np.asarray(force - np.sqrt(len(grasped)) * GOAL_DAMPING * velocity)


class CarryTask(GripperTask):
    """Discs of 1 kg without friction, of which a rule ties some together; a task's base.

    Nodes are the gripper (0), `targets` targets (1, 2, ...) and ``distractors`` further bodies of
    their node type. The control ``[2]`` N is a force on the gripper. An episode always runs for
    `steps` steps of 0.05 s. ``fixed_seed`` is the seed of a scene whose targets
    and goal every episode shares, so that only the start of gripper and distractors varies; None:
    each episode has its own. ``radius`` m is every body's; ``in_the_way``: a straight way touches
    two distractors or more. ``engine``: see `PlanarWorld`.

    A subclass may define another rule. Raises `InvalidInputError` for numbers out of range.
    """

    steps = 200
    """Of an episode."""
    targets = 1
    """Number of targets."""
    any_order = False
    """Whether any target may be carried first: see `sample_layout`."""
    types = ("gripper", "object")
    """Node types of the gripper, whose name it is, too, and of all others."""
    control_kind: tuple[str, ...] | None = None
    """Of a scene. None: a force."""

    def __init__(
        self,
        distractors: int = 0,
        fixed_seed: int | None = None,
        radius: float = RADIUS,
        in_the_way: bool = False,
        engine: str | None = None,
    ) -> None:
        check_count("distractors", distractors, 0, MAX_DISTRACTORS)
        if in_the_way and distractors < IN_THE_WAY:
            raise InvalidInputError(
                f"distractors must be {IN_THE_WAY} or more to be in the way, found {distractors}"
            )
        if not 0.0 < radius <= MAX_RADIUS:
            raise InvalidInputError(f"radius must be above 0, to {MAX_RADIUS} m, found {radius}")
        targets = self.targets
        count = 1 + targets + distractors
        super().__init__(count, self.steps, extent(targets), fixed_seed=fixed_seed)
        self.distractors = distractors
        self._engine, self._radius, self._in_the_way = engine, radius, in_the_way
        self._fixed = fixed_layout(
            fixed_seed,
            lambda rng: sample_layout(rng, targets, MAX_DISTRACTORS, any_order=self.any_order),
        )

    def hold_rule(self, seed: int) -> tuple[HoldRule | None, Metadata]:
        """The rule of an episode, with all randomness from ``seed``, and metadata of the scene.

        By default all that touch stick together.
        """
        return HoldAtTouch(), {}

    def body(self, place: np.ndarray, node: int, seed: int) -> PlanarBody:
        """The body of a node that starts at ``place`` ``[2]`` m."""
        return PlanarBody(place, MASS, radius=self._radius)

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        rng = np.random.default_rng(seed)
        layout = sample_layout(
            rng, self.targets, self.distractors, self._fixed, self._in_the_way, self.any_order
        )
        # A stream of its own: the draws of the layout depend on the number of distractors.
        rule, drawn = self.hold_rule(int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))
        bodies = [self.body(place, node, seed) for node, place in enumerate(layout.position)]
        world = PlanarWorld(bodies, DT, hold=rule, engine=self._engine)
        in_the_way = {"in_the_way": True} if self._in_the_way else {}
        targets = [f"target-{index}" for index in range(1, self.targets + 1)]
        distractors = [f"distractor-{index}" for index in range(self.distractors)]
        scene = Scene(
            node_name=(
                self.types[0],
                *(targets if self.targets > 1 else ["target"]),
                *distractors,
            ),
            node_type=(self.types[0], *[self.types[1]] * (len(bodies) - 1)),
            actuated=np.arange(len(bodies)) == GRIPPER,
            dt=DT,
            goal=layout.goal,
            mass=np.array([body.mass for body in bodies]),
            radius=np.full(len(bodies), self._radius),
            control_kind=self.control_kind,
            metadata={"distractors": self.distractors, **in_the_way, **drawn},
        )
        return scene, world


class PickupTask(CarryTask):
    """A gripper picks up an object and takes it to a goal.

    The paper's first planar task. Nodes are the gripper (0), the target (1) and ``distractors``
    further objects: circles that stick to all that they touch. The reward is the negative distance
    from target to goal, m. An episode always runs for 200 steps. Other arguments: see `CarryTask`.
    Raises `InvalidInputError` where ``distractors`` is not in 0 to 20, or 2 to 20 in the way, or
    the radius not above 0 and at most 0.06 m.
    """

    name = "pickup"
    expert = PickupExpert
    conditions: Conditions = (
        ("as trained", {}),
        ("3 distractors", {"distractors": 3}),
        ("10 distractors", {"distractors": 10}),
    )


class MultiPickupTask(CarryTask):
    """A gripper picks up objects in turn and takes them to a goal.

    The paper's second planar task. Nodes are the gripper (0), ``objects`` targets (1, 2, ...) in
    the order in which they are to be picked up, and ``distractors`` further objects: circles that
    stick to all that they touch, so that the grasped bodies form a growing group. The reward is the
    negative distance from the last target to the goal, m. An episode always runs for 200 steps.
    Other arguments: see `CarryTask`. Raises `InvalidInputError` where ``objects`` is not in 1 to 5
    or ``distractors`` in 0 to 20.
    """

    name = "multi-pickup"
    expert = PickupExpert
    conditions: Conditions = (("as trained, 2 picks", {}), ("5 picks", {"objects": 5}))

    def __init__(
        self,
        objects: int = 2,
        distractors: int = 0,
        fixed_seed: int | None = None,
        engine: str | None = None,
    ) -> None:
        check_count("objects", objects, 1, MAX_OBJECTS)
        self.targets, self.chain = objects, tuple(range(GRIPPER, 1 + objects))
        super().__init__(distractors, fixed_seed, engine=engine)

    def hold_rule(self, seed: int) -> tuple[HoldRule, Metadata]:
        """All that touch stick together."""
        return HoldAtTouch(), {"objects": self.targets}

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether every target is joined to the gripper and the last within 0.1 m of the goal."""
        every = set(range(1, self.targets + 1))
        return every <= held(contact) and super().solved(scene, position, contact)
