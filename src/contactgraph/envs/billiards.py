"""The billiards task: discs on a table with walls and pillars, which a driven cue strikes."""

from dataclasses import replace
from functools import partial

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import ChainCost, Conditions, Observation
from contactgraph.envs.exploration import NoisyPolicy
from contactgraph.envs.gripper_task import DT, GripperTask, check_count, fixed_layout
from contactgraph.envs.planar.body import GRAVITY, PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

CUE, TARGET = 0, 1
TABLE = np.array([1.0, 0.6])
"""Half the sides of the table, m; its middle is the origin."""
DISCS = {"cue": (1.0, 0.05), "ball": (0.5, 0.04), "puck": (1.5, 0.06), "pillar": (1.0, 0.06)}
"""Mass, kg, and radius, m, by node type. The mass of a pillar means nothing: it is static."""
MAX_OBJECTS = 8
OBJECT_TYPES = ("ball", "puck") * (MAX_OBJECTS // 2)
"""The types of the target, the first further object, the second, ..."""
PILLARS = 2
RESTITUTION = 0.9
"""Of every touch."""
FRICTION = 0.1
"""Coulomb's coefficient between two discs."""
GROUND_FRICTION = 0.05
"""Coulomb's coefficient between a disc and the table: a deceleration of 0.49 m/s^2."""
MAX_STEPS = 200
PASSIVE_STEPS = 80
SLOWEST, FASTEST = 0.3, 1.5
"""Speed of an object at the start without a cue, and of a random strike, m/s."""
SHOT = np.array([0.4, 1.1])
"""Distance from target to goal, at least and at most, m."""
RUN_UP = 0.35
"""Free length behind the target on the line to the goal, m."""
CORRIDOR = 0.19
"""The least distance of pillars and further objects from that line, m."""
GAP = 0.04
"""The least distance of two surfaces at the start, m."""

_TRIES = 400

Layout = tuple[np.ndarray, np.ndarray]
"""``[N, 2]`` m, the places of cue, target, further objects and pillars, and ``[2]`` m, the goal."""


def sample_layout(rng: np.random.Generator, objects: int, fixed: Layout | None = None) -> Layout:
    """Samples a layout with ``objects`` objects, uniformly over those that keep the distances.

    With ``fixed``, target and goal are those of this layout. A layout without space for every disc
    is rejected as a whole and sampled again.
    """
    types = ("ball", "cue", *OBJECT_TYPES[1:objects], *["pillar"] * PILLARS)
    radii = np.array([DISCS[kind][1] for kind in types])
    while True:
        target, goal = rng.uniform(-TABLE, TABLE), rng.uniform(-TABLE, TABLE)
        if fixed is not None:
            target, goal = fixed[0][TARGET], fixed[1]
        shot = goal - target
        length = float(np.linalg.norm(shot))
        start = target - RUN_UP * shot / length
        inside = [np.abs(start) <= TABLE - 0.07, np.abs(goal) <= TABLE - 0.15]
        if not (SHOT[0] <= length <= SHOT[1] and np.all(inside)):
            continue
        line, places = np.linspace(start, goal, 30), target[None]
        for placed, radius in enumerate(radii[1:], start=1):
            tries = rng.uniform(radius + GAP - TABLE, TABLE - radius - GAP, (_TRIES, 1, 2))
            apart = np.linalg.norm(places - tries, axis=-1) - radii[:placed] - radius
            free = apart.min(axis=1) >= GAP
            if placed > 1:  # the cue alone may be in the line of the shot
                free &= np.linalg.norm(line - tries, axis=-1).min(axis=1) >= CORRIDOR
            if not free.any():
                break
            places = np.vstack([places, tries[free.argmax()]])
        else:
            return np.vstack([places[1], target, places[2:]]), goal


STAND_OFF = 0.18
"""Distance of the two surfaces before the run-up, m."""
TIME_CONSTANT = 0.08
"""Of the cue's approach to a wanted velocity, s."""
STRAIGHT = np.array([0.01, 0.03])
"""Distance of the cue from the line of the shot, at most: to begin the run-up, to go on; m."""
AT_REST = 0.02
"""Speed below which the target is struck, m/s."""
NEAR_GOAL = 0.06
"""The target is left alone within this distance of the goal, m."""
CRUISE = 0.9
"""Speed of the cue on its way behind the target, at most, m/s."""
CLEARANCE = 0.14
"""Distance of two surfaces at which the cue begins to turn aside, m."""
BRAKING = 0.03
"""Distance from a wall at which the cue begins to brake, m."""
DETOUR = 0.4
"""Length of a shot that does not lead to the goal, at most, m."""
_HOLD = 25
"""Steps of a random strike."""
_TURNS = np.deg2rad([turn for step in range(19) for turn in (10 * step, -10 * step)])


class BilliardsExpert(NoisyPolicy):
    """Goes behind the target, on the line to the goal, and strikes it so that it stops there.

    The speed of the strike follows from the distance, the friction with the table and the law of
    the impact. A target that would stop elsewhere is struck again.
    """

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode; raises `InvalidInputError` where ``scene`` is no billiards."""
        there = "target" in scene.node_name and scene.actuated[CUE]
        if not there or scene.mass is None or scene.radius is None:
            raise InvalidInputError(
                "a billiards expert needs an actuated node 0, a node named target, masses and "
                f"radii, found nodes {list(scene.node_name)}"
            )
        self._target = scene.node_name.index("target")
        self._mass, self._radius = scene.mass, scene.radius
        super().reset(scene, seed)

    def _force(self, observation: Observation) -> np.ndarray:
        """``[2]`` N, without the noise."""
        position, velocity = observation["position"], observation["velocity"]
        shot = np.asarray(observation["goal"] - position[self._target])
        resting = np.linalg.norm(velocity[self._target]) <= AT_REST
        wanted = np.zeros(2)
        if resting and np.linalg.norm(shot) > NEAR_GOAL:
            wanted = self._velocity(position, velocity[CUE], self._feasible(position, shot))
        return np.asarray(self._mass[CUE] * (wanted - velocity[CUE]) / TIME_CONSTANT)

    def _feasible(self, position: np.ndarray, shot: np.ndarray) -> np.ndarray:
        """[2] m: the shot, turned as little as gives the cue a free position behind the target."""
        reach = self._radius[CUE] + self._radius
        others = [n for n in range(1, len(position)) if n != self._target]
        for turn in _TURNS:
            cos, sin = np.cos(turn), np.sin(turn)
            turned = np.array([cos * shot[0] - sin * shot[1], sin * shot[0] + cos * shot[1]])
            behind = self._behind(position, turned)
            apart = np.linalg.norm(position[others] - behind, axis=-1) - reach[others]
            inside = np.all(np.abs(behind) < TABLE - self._radius[CUE] - 0.5 * BRAKING)
            if inside and np.all(apart > 0.5 * CLEARANCE):
                return turned if turn == 0.0 else turned * min(1.0, DETOUR / np.hypot(*shot))
        return shot

    def _behind(self, position: np.ndarray, shot: np.ndarray) -> np.ndarray:
        distance = self._radius[CUE] + self._radius[self._target] + STAND_OFF
        return np.asarray(position[self._target] - distance * shot / np.linalg.norm(shot))

    def _velocity(self, position: np.ndarray, velocity: np.ndarray, shot: np.ndarray) -> np.ndarray:
        """[2] m/s, wanted of the cue."""
        length = float(np.linalg.norm(shot))
        ahead = shot / length
        offset = position[CUE] - position[self._target]
        along = float(offset @ ahead)
        aside = offset - along * ahead
        running = float(velocity @ ahead) > 0.3
        if along < 0.0 and np.linalg.norm(aside) < STRAIGHT[int(running)]:
            share = self._mass[CUE] / (self._mass[CUE] + self._mass[self._target])
            after = np.sqrt(2.0 * (GRAVITY * GROUND_FRICTION) * length)
            strike = after / ((1.0 + RESTITUTION) * share)
            return np.asarray(strike * ahead - aside / (2.0 * TIME_CONSTANT))
        way = self._behind(position, shot) - position[CUE]
        wanted = way * min(0.4 / TIME_CONSTANT, CRUISE / max(float(np.linalg.norm(way)), 1e-9))
        for node in range(1, len(position)):
            reach = float(self._radius[CUE] + self._radius[node])
            clearance = STAND_OFF if node == self._target else CLEARANCE
            wanted = _turned_aside(wanted, position[CUE] - position[node], reach, clearance)
        for axis in range(2):
            gap = TABLE[axis] - self._radius[CUE] - abs(position[CUE, axis])
            if gap < BRAKING and wanted[axis] * position[CUE, axis] > 0.0:
                wanted[axis] *= max(gap, 0.0) / BRAKING
        return wanted


def _turned_aside(
    wanted: np.ndarray, away: np.ndarray, reach: float, clearance: float
) -> np.ndarray:
    """``wanted`` [2] m/s without its part towards a near disc, and around the disc instead."""
    distance = float(np.linalg.norm(away))
    normal = away / distance
    closing = -float(wanted @ normal)
    nearness = min(1.0 - (distance - reach) / clearance, 1.0)
    if nearness <= 0.0 or closing <= 0.0:
        return wanted
    tangent = np.array([-normal[1], normal[0]])
    side = 1.0 if wanted @ tangent >= 0.0 else -1.0
    return np.asarray(wanted + nearness * closing * (1.5 * normal + side * tangent))


class StrikingPolicy(NoisyPolicy):
    """Drives the cue at one object after the other, drawn every 25 steps: for exploration."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode."""
        self._objects = np.flatnonzero(scene.passive)
        self._rng = np.random.default_rng(seed)
        super().reset(scene, seed)
        self._step = 0

    def _force(self, observation: Observation) -> np.ndarray:
        """``[2]`` N, without the noise."""
        if self._step % _HOLD == 0:
            self._aim = int(self._rng.choice(self._objects))
            self._speed = self._rng.uniform(SLOWEST, FASTEST)
        self._step += 1
        way = observation["position"][self._aim] - observation["position"][CUE]
        wanted = self._speed * way / max(float(np.linalg.norm(way)), DT)
        return np.asarray((wanted - observation["velocity"][CUE]) / TIME_CONSTANT)


class BilliardsTask(GripperTask):
    """A cue strikes a disc to a goal, on a table with walls, pillars and other discs.

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
    expert = BilliardsExpert
    fixed_start = partial(BilliardsExpert, noise=0.0)
    explorer = StrikingPolicy
    horizon, starts = 60, 64
    conditions: Conditions = (("as trained", {}), ("6 objects", {"objects": 6}))

    def __init__(
        self,
        objects: int = 3,
        passive: bool = False,
        fixed_seed: int | None = None,
        engine: str | None = None,
    ) -> None:
        check_count("objects", objects, 1, MAX_OBJECTS)
        self.passive, self._objects, self._engine = passive, objects, engine
        self.chain = (0,) if passive else (CUE, TARGET)
        self._types = ("cue", *OBJECT_TYPES[:objects], *["pillar"] * PILLARS)[int(passive) :]
        steps, extent = PASSIVE_STEPS if passive else MAX_STEPS, float(TABLE.max())
        super().__init__(len(self._types), steps, extent, fixed_seed=fixed_seed)
        self._fixed = fixed_layout(fixed_seed, lambda rng: sample_layout(rng, MAX_OBJECTS))

    def begin(self, seed: int) -> tuple[Scene, PlanarWorld]:
        """Samples the scene of a seed; at rest, unless it is passive."""
        rng = np.random.default_rng(seed)
        places, goal = sample_layout(rng, self._objects, self._fixed)
        position = places[int(self.passive) :]
        velocity = np.zeros_like(position)
        if self.passive:
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
            for index in range(len(position))
        ]
        walls = np.array([-TABLE, TABLE])
        world = PlanarWorld(bodies, DT, walls=walls, engine=self._engine)
        scene = Scene(
            node_name=(
                *["cue"] * (not self.passive),
                "target",
                *(f"object-{index}" for index in range(1, self._objects)),
                *(f"pillar-{index}" for index in range(1, 1 + PILLARS)),
            ),
            node_type=self._types,
            actuated=np.array([kind == "cue" for kind in self._types]),
            dt=DT,
            goal=goal,
            mass=mass,
            radius=radius,
            static=static,
            control_kind=() if self.passive else ("force", "force"),
            planes=np.hstack([np.vstack([np.eye(2), -np.eye(2)]), np.tile(-TABLE, 2)[:, None]]),
            metadata={
                "objects": self._objects,
                "passive": self.passive,
                "restitution": RESTITUTION,
                "friction": FRICTION,
                "ground_friction": GROUND_FRICTION,
            },
        )
        return scene, world

    def cost_terms(self) -> ChainCost:
        """Cue to target and target to goal, with the weights of the pickup; the end counts most."""
        return replace(super().cost_terms(), terminal_weight=100.0)
