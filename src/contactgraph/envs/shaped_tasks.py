"""Tasks of boxes under gravity: a toss, dominoes, a stack."""

from abc import abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from contactgraph.data import Scene
from contactgraph.envs.gripper_task import GripperTask
from contactgraph.envs.planar.body import PlanarBody

if TYPE_CHECKING:
    from contactgraph.envs.mujoco_world import VerticalWorld

BOX = np.array([0.05, 0.03])
"""Half the sides of a tossed or stacked box, m."""
BOX_MASS = 0.5
"""kg"""
BOX_FRICTION = 0.4
DT = 0.02
"""Time between two steps of boxes, s."""
STANDING_STILL = 0.001
"""A stack stands if no box has moved by more, m, or turned by more, rad."""
AT_REST = 0.01
"""Speed, m/s, and angular velocity, rad/s, of a body at rest, at most."""


def box_outline(half_size: np.ndarray) -> np.ndarray:
    """[4, 2] m: the corners of a box in its own frame, counter-clockwise."""
    return np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half_size


class VerticalTask(GripperTask):
    """Boxes of one type in a vertical plane above a floor, on MuJoCo; nothing is driven.

    Nodes are the boxes. The axes are x to the right and y up, the floor is the plane y = 0. The
    control is empty. Contacts are those between boxes during the step that leads to a state. The
    goal, which nothing steers to, is where the last box starts. A subclass defines the boxes.
    """

    passive = True
    max_force = None
    observes_turning = True
    count: int
    """Of the boxes."""
    kind: str
    """Node type of the boxes."""
    steps = 100
    """Of an episode."""
    contact_time = 1.5e-3
    """s, of the simulator's contacts: no overlap is deeper than 1 mm."""

    def __init__(self) -> None:
        # Raises `InvalidInputError` if MuJoCo is missing.
        import contactgraph.envs.mujoco_world  # noqa: F401

        super().__init__(self.count, self.steps, 1.0, dt=DT)
        self.chain = (self.count - 1,)

    @abstractmethod
    def boxes(self, rng: np.random.Generator) -> list[PlanarBody]:
        """The boxes of an episode."""

    def begin(self, seed: int) -> "tuple[Scene, VerticalWorld]":
        """Samples the scene of a seed."""
        from contactgraph.envs import mujoco_world

        boxes, count = self.boxes(np.random.default_rng(seed)), self.count
        world = mujoco_world.VerticalWorld(boxes, DT, self.contact_time)
        scene = Scene(
            node_name=(self.kind,)
            if count == 1
            else tuple(f"{self.kind}-{i}" for i in range(count)),
            node_type=(self.kind,) * count,
            actuated=np.zeros(count, dtype=bool),
            dt=DT,
            goal=boxes[-1].position,
            gravity=mujoco_world.GRAVITY,
            mass=np.array([box.mass for box in boxes]),
            static=np.zeros(count, dtype=bool),
            control_kind=(),
            planes=np.array([[0.0, 1.0, 0.0]]),
            polygons=tuple(box_outline(box.size) for box in boxes),
            polygon_of=np.arange(count),
            metadata={"friction": boxes[0].friction, "contact_time": self.contact_time},
        )
        return scene, world


class TossTask(VerticalTask):
    """A box is tossed onto the floor (MuJoCo).

    The box has 10 by 6 cm and 0.5 kg. It starts 0.2 to 0.5 m high at any angle, with up to 1.5 m/s
    sideways, 1 m/s up or down and 12 rad/s. The coefficient of friction is 0.4. An episode runs for
    75 steps of 0.02 s, and succeeds if the box is at rest at its end.
    """

    name = "toss"
    kind = "box"
    count = 1
    steps = 75
    contact_time = 7e-4

    def boxes(self, rng: np.random.Generator) -> list[PlanarBody]:
        """One box in flight."""
        height, angle = rng.uniform([0.2, -np.pi], [0.5, np.pi])
        velocity = rng.uniform([-1.5, -1.0], [1.5, 1.0])
        box = _box(BOX, BOX_MASS, BOX_FRICTION, 0.0, height)
        spin = rng.uniform(-12.0, 12.0)
        return [replace(box, velocity=velocity, angle=angle, angular_velocity=spin)]

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the box is at rest."""
        world: Any = self.world
        return bool(
            max(np.abs(world.velocity).max(), np.abs(world.angular_velocity).max()) <= AT_REST
        )


DOMINO = np.array([0.01, 0.05])
"""Half the sides of a domino, m."""
DOMINO_MASS = 0.2
"""kg"""
DOMINO_FRICTION = 0.3
DOMINOES = 10
FALLEN = np.pi / 4.0
"""A domino that has turned by more has fallen, rad."""


def fallen(orientation: np.ndarray) -> np.ndarray:
    """[...] bool: which dominoes have fallen, by their ``orientation`` [..., 1] rad."""
    return np.asarray(np.abs(orientation[..., 0]) > FALLEN)


class DominoesTask(VerticalTask):
    """A row of ten dominoes falls, as far as it does (MuJoCo).

    Dominoes are 10 cm high, 2 cm thick and 0.2 kg heavy, with a coefficient of friction of 0.3.
    The gaps between them are 2.5 to 7 cm; in two scenes of three, one gap behind the second domino
    is 8 to 16 cm, so that the rest of the row may keep standing. The first domino starts upright,
    turning about its lower front edge at 3 to 6 rad/s, of which 2.4 tip it over. An episode runs
    for 100 steps of 0.02 s, and succeeds if all have fallen at its end (`fallen`).
    """

    name = "dominoes"
    kind = "domino"
    count = DOMINOES

    def boxes(self, rng: np.random.Generator) -> list[PlanarBody]:
        """The row, from left to right."""
        gaps = rng.uniform(0.025, 0.07, DOMINOES - 1)
        wide, width = int(rng.integers(1, DOMINOES - 1)), rng.uniform(0.08, 0.16)
        if rng.random() < 2.0 / 3.0:
            gaps[wide] = width
        places = np.concatenate([[0.0], np.cumsum(gaps + 2.0 * DOMINO[0])])
        row = [_box(DOMINO, DOMINO_MASS, DOMINO_FRICTION, x, DOMINO[1]) for x in places]
        rate = rng.uniform(3.0, 6.0)
        row[0] = replace(row[0], velocity=rate * DOMINO[::-1], angular_velocity=-rate)
        return row

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether all dominoes have fallen."""
        return bool(fallen(self.observed()["orientation"]).all())


class StackTask(VerticalTask):
    """Three boxes stand on one another (MuJoCo).

    Each has 10 by 6 cm and 0.5 kg, and stands up to 2 cm beside the middle of the stack. The
    coefficient of friction is 0.4. An episode runs for 100 steps of 0.02 s, and succeeds if no box
    has moved by 1 mm or 1 mrad.
    """

    name = "stack"
    kind = "box"
    count = 3

    def boxes(self, rng: np.random.Generator) -> list[PlanarBody]:
        """The stack, from below."""
        places = rng.uniform(-0.02, 0.02, 3)
        heights = BOX[1] * (1.0 + 2.0 * np.arange(3))
        return [
            _box(BOX, BOX_MASS, BOX_FRICTION, x, y) for x, y in zip(places, heights, strict=True)
        ]

    def solved(self, scene: Scene, position: np.ndarray, contact: np.ndarray) -> bool:
        """Whether the boxes are where they were."""
        start = self.boxes(np.random.default_rng(int(scene.metadata["seed"])))
        moved = np.linalg.norm(position - [box.position for box in start], axis=-1)
        turned = np.abs(self.observed()["orientation"])
        return bool(max(moved.max(), turned.max()) <= STANDING_STILL)


def _box(half_size: np.ndarray, mass: float, friction: float, x: float, y: float) -> PlanarBody:
    """An upright box at rest."""
    place = np.array([x, y])
    return PlanarBody(place, mass, half_size=half_size, rotates=True, friction=friction)
