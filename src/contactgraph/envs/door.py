"""The door task, in which a gripper opens a hinged door, and the sampling of its scenes."""

from dataclasses import dataclass, replace

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Conditions, Observation
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
from contactgraph.envs.pickup import HOLDING_DAMPING, STIFFNESS, pd_force
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

LENGTH = 1.0
"""Of every door, m."""
THICKNESS = 0.05
"""Of every door, m."""
HALF_WIDTH = 1.0
"""Half the side of the square that the gripper starts in, m."""
HINGE_HALF_WIDTH = 0.2
"""Half the side of the square that the target door's hinge lies in, m."""
DISTRACTOR_HALF_WIDTH = 3.0
"""Half the side of the square that the distractors' hinges lie in, m."""
REACH = 0.4
"""The least distance of the gripper's centre from the door's middle line, m, to gain speed."""
STEEPEST = np.deg2rad(60.0)
"""The path to the door's middle is at most this far from perpendicular to the door, rad."""
SMALLEST_SWING = np.deg2rad(20.0)
"""From the initial to the goal angle, rad."""
LARGEST_SWING = np.deg2rad(80.0)
"""From the initial to the goal angle, rad."""
OVERSHOOT = np.deg2rad(20.0)
"""By how much a door may swing beyond its initial and its goal angle, rad."""
CORRIDOR = 0.35
"""The least distance of a distractor from the swept area, from the path and from others, m."""

_SPACING = 0.05
"""Distance between the sampled points of a line, m: costs 1 mm of `CORRIDOR`."""
_TRIES_PER_DISTRACTOR = 200


@dataclass(frozen=True, eq=False)
class DoorLayout:
    """Start and goal of an episode; door 0 is the target, the others are distractors."""

    gripper: np.ndarray
    """[2] m."""
    hinge: np.ndarray
    """[1 + M, 2] m."""
    angle: np.ndarray
    """[1 + M] rad, of the direction from the hinge to the door's middle."""
    goal_angle: float
    """Of door 0, rad."""


def middle(hinge: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """[..., 2] m: the middles of doors with hinges ``[..., 2]`` m at angles ``[...]`` rad."""
    return hinge + 0.5 * LENGTH * _direction(angle)


def sample_layout(
    rng: np.random.Generator, distractors: int, fixed: DoorLayout | None = None
) -> DoorLayout:
    """Samples a layout, uniformly over those that satisfy the distances above.

    With ``fixed``, door 0 and its goal are those of this layout; all else is sampled. A layout
    without space for every distractor is rejected as a whole and sampled again.
    """
    while True:
        hinge = rng.uniform(-HINGE_HALF_WIDTH, HINGE_HALF_WIDTH, 2)
        angle = rng.uniform(-np.pi, np.pi)
        swing = rng.uniform(SMALLEST_SWING, LARGEST_SWING) * rng.choice([-1.0, 1.0])
        goal_angle = float(angle + swing)
        gripper = rng.uniform(-HALF_WIDTH, HALF_WIDTH, 2)
        if fixed is not None:
            hinge, angle, goal_angle = fixed.hinge[0], float(fixed.angle[0]), fixed.goal_angle
        path = middle(hinge, angle) - gripper
        steep = abs(path @ _direction(angle)) > np.sin(STEEPEST) * np.linalg.norm(path)
        if steep or _distance(gripper[None], _bar(hinge, angle)) < REACH:
            continue
        low, high = sorted([angle, goal_angle])
        turns = np.arange(low - OVERSHOOT, high + OVERSHOOT, _SPACING / LENGTH)
        taken = [_line(gripper, gripper + path), *(_bar(hinge, turn) for turn in turns)]
        others = _place_distractors(rng, np.concatenate(taken), distractors)
        if others is not None:
            hinges, angles = np.vstack([hinge, others[:, :2]]), np.append(angle, others[:, 2])
            return DoorLayout(gripper, hinges, angles, goal_angle)


def _place_distractors(
    rng: np.random.Generator, taken: np.ndarray, count: int
) -> np.ndarray | None:
    """[count, 3] hinge m and angle rad, clear of ``taken`` ``[P, 2]`` m; None without space."""
    placed: list[np.ndarray] = []
    bound = np.array([DISTRACTOR_HALF_WIDTH, DISTRACTOR_HALF_WIDTH, np.pi])
    for candidate in rng.uniform(-bound, bound, (_TRIES_PER_DISTRACTOR * count, 3)):
        if len(placed) == count:
            break
        bar = _bar(candidate[:2], candidate[2])
        if _distance(bar, taken) >= CORRIDOR:
            placed.append(candidate)
            taken = np.concatenate([taken, bar])
    return np.reshape(placed, (count, 3)) if len(placed) == count else None


def _direction(angle: np.ndarray | float) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _bar(hinge: np.ndarray, angle: float) -> np.ndarray:
    """[P, 2] m: the middle line of a door."""
    return _line(hinge, hinge + LENGTH * _direction(angle))


def _line(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """[P, 2] m: points sampled from the line."""
    count = 2 + int(np.linalg.norm(end - start) / _SPACING)
    return np.linspace(start, end, count)


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one[:, None] - other, axis=-1).min())


DOOR = 1
MAX_STEPS = 120
DOOR_MASS = 4.0
"""kg."""
GRIPPER_RADIUS = 0.04
"""m."""
MAX_DISTRACTORS = 10
TURN_DAMPING = 2.0 * np.sqrt(STIFFNESS)
"""N m s/rad per kg m^2: critical. The paper's 4 sqrt(Kp) would be too slow."""
_LEAST_RADIUS = 0.1
"""m; the least assumed distance of the gripper to the hinge, which bounds the force."""


class DoorExpert(NoisyPolicy):
    """Strikes the door at its middle, at speed, and turns it to the goal: two PD controllers.

    Their stiffness is that of the pickups. On the turn the torque is proportional to the moment of
    inertia of door and gripper about the hinge, so that every door takes the same time.
    """

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` has no door."""
        hinged = scene.node_count > DOOR and scene.hinged[DOOR]
        if not hinged or scene.goal is None or scene.mass is None:
            raise InvalidInputError(
                f"a door expert needs a node {DOOR} with an anchor, a goal and masses, found nodes "
                f"{list(scene.node_name)} and anchor {scene.anchor.tolist()}"
            )
        self._hinge, self._mass = scene.anchor[DOOR], scene.mass[[GRIPPER, DOOR]]
        super().reset(scene, seed)

    def _force(self, observation: Observation) -> np.ndarray:
        """``[2]`` N, without the noise."""
        position, velocity = observation["position"], observation["velocity"]
        if observation["contact"][GRIPPER, DOOR]:
            return self._turn(position, velocity, observation["goal"])
        return pd_force(position[DOOR] - position[GRIPPER], velocity[GRIPPER], HOLDING_DAMPING)

    def _turn(self, position: np.ndarray, velocity: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """[2] N perpendicular to the gripper's radius vector."""
        bar, aim = position[DOOR] - self._hinge, goal - self._hinge
        radius_vector = position[GRIPPER] - self._hinge
        # A thin rod about its end: four thirds of m r^2, r from the hinge to the middle.
        inertia = self._mass @ [radius_vector @ radius_vector, 4.0 / 3.0 * (bar @ bar)]
        left = np.array([-bar[1], bar[0]])
        missing = np.arctan2(left @ aim, bar @ aim)
        rate = (left @ velocity[DOOR]) / (bar @ bar)
        torque = inertia * (STIFFNESS * missing - TURN_DAMPING * rate)
        radius = float(np.linalg.norm(radius_vector))
        across = np.array([-radius_vector[1], radius_vector[0]])
        return torque / max(radius, _LEAST_RADIUS) * across / radius


class DoorTask(GripperTask):
    """A gripper opens a hinged door to an angle.

    The paper's third planar task. Nodes are the gripper (0), the target door (1) and
    ``distractors`` further doors. A door is a bar, 4 kg, 0.05 x 1.0 m, that turns freely about a
    hinge at one end (``scene.anchor``); its node is its middle. The gripper is pinned to every door
    that it touches, where it touches it; doors pass through one another. The control ``[2]`` N is a
    force on the gripper. The reward is the negative distance of the door's middle from where it is
    at the goal angle, m. An episode always runs for 120 steps.

    ``fixed_seed`` is the seed of a scene whose target door (hinge, angle) and goal every episode
    shares, so that only the start of the gripper and the other doors vary; None: each has its own.

    ``engine``: see `PlanarWorld`. Raises `InvalidInputError` where ``distractors`` is not in 0 to
    10.
    """

    name = "door"
    expert = DoorExpert
    conditions: Conditions = (("as trained", {}), ("10 more doors", {"distractors": 10}))
    goal_radius = 0.05
    """m: 0.1 rad."""

    def __init__(
        self, distractors: int = 0, fixed_seed: int | None = None, engine: str | None = None
    ) -> None:
        check_count("distractors", distractors, 0, MAX_DISTRACTORS)
        extent = DISTRACTOR_HALF_WIDTH + LENGTH
        super().__init__(2 + distractors, MAX_STEPS, extent, fixed_seed=fixed_seed)
        self._distractors = distractors
        self._engine = engine
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_DISTRACTORS))

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed, with everything at rest."""
        layout = sample_layout(np.random.default_rng(seed), self._distractors, self._fixed)
        gripper = PlanarBody(layout.gripper, MASS, radius=GRIPPER_RADIUS)
        half = np.array([LENGTH, THICKNESS]) / 2.0
        bars = [
            PlanarBody(
                middle(hinge, angle), DOOR_MASS, half_size=half, angle=angle, anchor=hinge, group=-1
            )
            for hinge, angle in zip(layout.hinge, layout.angle, strict=True)
        ]
        world = PlanarWorld([gripper, *bars], DT, hold=HoldAtTouch(), engine=self._engine)
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
                "distractors": self._distractors,
                "angle": float(layout.angle[0]),
                "goal_angle": layout.goal_angle,
            },
        )
        return scene, world

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the gripper is at the door, and its middle within 0.05 m of the goal."""
        return bool(contact[GRIPPER, DOOR]) and super().solved(scene, position, contact)

    def cost_terms(self) -> ChainCost:
        """Gripper to door with the paper's weights, door to goal with those of pickup.

        The paper's own, 1 and 2, leave the door 3 to 25 cm from its goal at the end.
        """
        return replace(super().cost_terms(), pick_weights=np.array([6.5, 6.5, 0.2, 0.2]))
