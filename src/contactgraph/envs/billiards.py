"""The billiards task: discs on a table with walls and pillars, which a driven cue strikes."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.gripper_task import DT, GripperTask, check_count, fixed_layout
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

CUE, TARGET = 0, 1
TABLE = np.array([1.0, 0.6])
"""Half the sides of the table, m; its middle is the origin."""
DISCS = {"cue": (1.0, 0.05), "ball": (0.5, 0.04), "puck": (1.5, 0.06), "pillar": (1.0, 0.06)}
"""Mass, kg, and radius, m, by node type. The mass of a pillar means nothing: it is static."""
OBJECT_TYPES = ("ball", "puck")
"""The types of target, first further object, second, ... in turn."""
PILLARS = 2
RESTITUTION = 0.9
"""Of every touch."""
FRICTION = 0.1
"""Coulomb's coefficient between two discs."""
GROUND_FRICTION = 0.05
"""Coulomb's coefficient between a disc and the table: a deceleration of 0.49 m/s^2."""
MAX_STEPS = 200
PASSIVE_STEPS = 80
MAX_OBJECTS = 8
FASTEST = 1.5
"""Speed of an object at the start without a cue, at most, m/s."""
SLOWEST = 0.3
"""The same, at least."""
SHOT = np.array([0.4, 1.1])
"""Distance from target to goal, at least and at most, m."""
RUN_UP = 0.35
"""Free length behind the target on the line to the goal, m."""
CORRIDOR = 0.19
"""The least distance of pillars and further objects from that line, m."""
GAP = 0.04
"""The least distance of two surfaces at the start, m."""

_TRIES = 400


@dataclass(frozen=True, eq=False)
class BilliardsLayout:
    """Start and goal of an episode."""

    cue: np.ndarray
    """[2] m."""
    target: np.ndarray
    """[2] m."""
    goal: np.ndarray
    """[2] m."""
    others: np.ndarray
    """[O + P, 2] m: further objects, then pillars."""


def sample_layout(
    rng: np.random.Generator, objects: int, fixed: BilliardsLayout | None = None
) -> BilliardsLayout:
    """Samples a layout with ``objects`` objects, uniformly over those that keep the distances.

    With ``fixed``, target and goal are those of this layout. A layout without space for every disc
    is rejected as a whole and sampled again.
    """
    types = [_type_of(index) for index in range(1, objects)] + ["pillar"] * PILLARS
    while True:
        target, goal = rng.uniform(-TABLE, TABLE), rng.uniform(-TABLE, TABLE)
        if fixed is not None:
            target, goal = fixed.target, fixed.goal
        shot = goal - target
        length = float(np.linalg.norm(shot))
        start = target - RUN_UP * shot / length
        inside = [np.abs(start) <= TABLE - 0.07, np.abs(goal) <= TABLE - 0.15]
        if not (SHOT[0] <= length <= SHOT[1] and np.all(inside)):
            continue
        line = np.linspace(start, goal, 30)
        places, radii = [target], [DISCS["ball"][1]]
        for kind in ["cue", *types]:
            radius = DISCS[kind][1]
            place = _free_place(rng, np.array(places), np.array(radii), radius, line, kind)
            if place is None:
                break
            places.append(place)
            radii.append(radius)
        if len(places) == 2 + len(types):
            return BilliardsLayout(places[1], target, goal, np.reshape(places[2:], (-1, 2)))


def _free_place(
    rng: np.random.Generator,
    places: np.ndarray,
    radii: np.ndarray,
    radius: float,
    line: np.ndarray,
    kind: str,
) -> np.ndarray | None:
    """[2] m, clear of the discs before it and, but for the cue, of the line of the shot."""
    for candidate in rng.uniform(radius + GAP - TABLE, TABLE - radius - GAP, (_TRIES, 2)):
        apart = np.linalg.norm(places - candidate, axis=-1) - radii - radius
        clear = kind == "cue" or np.linalg.norm(line - candidate, axis=-1).min() >= CORRIDOR
        if clear and apart.min() >= GAP:
            return np.asarray(candidate)
    return None


def _type_of(index: int) -> str:
    """Node type of object ``index``; the target is object 0."""
    return OBJECT_TYPES[index % len(OBJECT_TYPES)]


class BilliardsTask(GripperTask):
    """Discs slide on a table, strike one another, walls and pillars; a `contactgraph.envs.Task`.

    Nodes are the cue (0), a disc that the control ``[2]`` N drives, the target (1), further objects
    and two pillars, which never move. Balls (0.5 kg, 0.04 m) and pucks (1.5 kg, 0.06 m) alternate;
    the target is a ball. Discs do not rotate. Coulomb friction with the table decelerates them by
    0.49 m/s^2 until they rest; between two discs its coefficient is 0.1, with walls there is none.
    Contacts are those during the step that leads to a state: a bounce is shorter than a step.

    An episode runs for 200 steps, and succeeds if the target is within 0.1 m of the goal at its
    *end*. ``passive``: without the cue, so that node 0 is the target; the control is empty, objects
    start at 0.3 to 1.5 m/s in all directions, and an episode runs for 80 steps.

    ``objects`` counts the target. ``fixed_seed`` is the seed of a scene whose target and goal every
    episode shares. ``engine``: see `PlanarWorld`. Raises `InvalidInputError` where ``objects`` is
    not in 1 to 8.
    """

    name = "billiards"

    def __init__(
        self,
        objects: int = 3,
        passive: bool = False,
        fixed_seed: int | None = None,
        engine: str | None = None,
    ) -> None:
        check_count("objects", objects, 1, MAX_OBJECTS)
        driven = not passive
        steps = MAX_STEPS if driven else PASSIVE_STEPS
        count = driven + objects + PILLARS
        extent = float(TABLE.max())
        super().__init__(count, steps, extent, passive=passive, fixed_seed=fixed_seed)
        self._types = (
            *["cue"] * driven,
            *(_type_of(index) for index in range(objects)),
            *["pillar"] * PILLARS,
        )
        self._objects = objects
        self._passive = passive
        self._engine = engine
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_OBJECTS))

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed; at rest, unless it is passive."""
        rng = np.random.default_rng(seed)
        layout = sample_layout(rng, self._objects, self._fixed)
        position = np.vstack([layout.cue, layout.target, layout.others])[int(self._passive) :]
        count = len(position)
        velocity = np.zeros((count, 2))
        if self._passive:
            speed, heading = rng.uniform([SLOWEST, -np.pi], [FASTEST, np.pi], (self._objects, 2)).T
            moving = speed * np.array([np.cos(heading), np.sin(heading)])
            velocity[: self._objects] = moving.T
        static = np.array([kind == "pillar" for kind in self._types])
        mass, radius = np.array([DISCS[kind] for kind in self._types]).T
        bodies = [
            PlanarBody(
                position[index],
                mass[index],
                radius=radius[index],
                velocity=velocity[index],
                static=bool(static[index]),
                restitution=RESTITUTION,
                friction=FRICTION,
                ground_friction=0.0 if static[index] else GROUND_FRICTION,
            )
            for index in range(count)
        ]
        walls = np.array([-TABLE, TABLE])
        world = PlanarWorld(bodies, DT, walls=walls, engine=self._engine)
        scene = Scene(
            node_name=(
                *["cue"] * (not self._passive),
                "target",
                *(f"object-{index}" for index in range(1, self._objects)),
                *(f"pillar-{index}" for index in range(1, 1 + PILLARS)),
            ),
            node_type=self._types,
            actuated=np.array([kind == "cue" for kind in self._types]),
            dt=DT,
            goal=layout.goal,
            mass=mass,
            radius=radius,
            static=static,
            control_kind=() if self._passive else ("force", "force"),
            planes=np.hstack([np.vstack([np.eye(2), -np.eye(2)]), np.tile(-TABLE, 2)[:, None]]),
            metadata={
                "task": self.name,
                "objects": self._objects,
                "passive": self._passive,
                "restitution": RESTITUTION,
                "friction": FRICTION,
                "ground_friction": GROUND_FRICTION,
                **world.metadata,
            },
        )
        return scene, world

    def cost_terms(self) -> ChainCost:
        """Cue to target and target to goal, with the weights of the pickup; the end counts most."""
        return ChainCost(
            chain=(0,) if self._passive else (CUE, TARGET),
            pick_weights=np.array([3.0, 3.0, 0.2, 0.2]),
            goal_weights=np.array([50.0, 50.0, 1.0, 1.0]),
            control_weight=0.01,
            terminal_weight=100.0,
        )
