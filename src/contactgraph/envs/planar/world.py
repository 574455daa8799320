"""A world of bodies in the plane, on one of two physics engines, that planar tasks are made of.

The engine resolves a touch itself: impulses by its sequential solver, with restitution and Coulomb
friction. A `HoldRule` looks at the world after every substep and may tie bodies together or part
them; a joint takes effect from the next substep on. A touch in the last substep of a step is
therefore recorded with an impact that is not complete: what the joint adds to the contact (the
relative velocity along the surfaces becomes zero, and bodies behind the struck one feel the blow)
follows in the next step.
"""

import copy
import importlib
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.envs.planar.body import PlanarBody

ENGINES = {"box2d": "Box2D", "pymunk": "pymunk"}
"""Names of the engines, the preferred one first, and the modules that they need."""

Pair = tuple[int, int]
"""Two nodes, the lower index first."""


class HoldRule(Protocol):
    """Decides which bodies of one world are tied together."""

    def update(self, world: "PlanarWorld", dt: float) -> None:
        """Called after every substep of ``dt`` s; may call ``world.join`` and ``world.part``."""


class Engine(Protocol):
    """Bodies in a physics engine; a node is a body's index."""

    simulator: str
    """Name and version."""
    touching: set[Pair]
    """The pairs in contact in the last substep; none that is joined."""

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position of the bodies' middles ``[N, 2]`` m, and angle ``[N]`` rad, not wrapped."""

    @property
    def twist(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of the bodies' middles ``[N, 2]`` m/s, and angular velocity ``[N]`` rad/s."""

    def advance(self, force: np.ndarray) -> None:
        """Moves on by a substep under ``force`` ``[N, 2]`` N on the bodies' middles."""

    def join(self, pair: Pair) -> None:
        """Pins a pair that is not joined together where it is: see `PlanarWorld.join`."""

    def part(self, pair: Pair) -> None:
        """Ends what `join` has made."""

    def joint_force(self, pair: Pair) -> np.ndarray:
        """``[2]`` N, of the joint on its second body in the last substep; zeros for a new one."""


class PlanarWorld:
    """``N`` bodies in the plane, without gravity in it.

    ``dt`` s is the time a call of `step` takes, in ``substeps`` equal parts. ``hold`` ties bodies
    together; None: nothing does. ``walls`` ``[2, 2]`` m are the lower and the upper corner of four
    walls without friction around the bodies; None: none. ``engine`` is "box2d" or "pymunk"; None:
    the first of them that is installed. `copy.deepcopy` of a world, or of a task that has one, is
    in the same state, to the last bit, and takes as long as all steps so far. Raises
    `InvalidInputError` for numbers out of range, and for an engine that is unknown or not
    installed.
    """

    switch: float = 0.0
    """The last commanded switch, 0 (off) to 1 (on), for a `HoldRule`; set by a task."""

    def __init__(
        self,
        bodies: Sequence[PlanarBody],
        dt: float,
        substeps: int = 10,
        hold: HoldRule | None = None,
        walls: np.ndarray | None = None,
        engine: str | None = None,
    ) -> None:
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        self._arguments = bodies, dt, substeps, copy.deepcopy(hold), walls, engine
        self._calls: list[tuple[Any, ...]] = []
        self._substeps, self._substep_time = substeps, dt / substeps
        module = importlib.import_module(f"contactgraph.envs.planar.{engine_name(engine)}_engine")
        self._engine: Engine = module.ENGINE(bodies, self._substep_time, walls)
        self._count = len(bodies)
        self._joined: set[Pair] = set()
        self._touched: set[Pair] = set()
        self.hold = hold
        """The rule that ties bodies together; copies have the one of the start."""
        self._under_rule = False

    @property
    def metadata(self) -> dict[str, str | int | float | bool]:
        """Engine and substeps, for a scene's metadata."""
        return {"simulator": self._engine.simulator, "substeps": self._substeps}

    @property
    def position(self) -> np.ndarray:
        """``[N, 2]`` m, of the bodies' middles."""
        return self._engine.pose[0]

    @property
    def velocity(self) -> np.ndarray:
        """``[N, 2]`` m/s of the same points."""
        return self._engine.twist[0]

    @property
    def angle(self) -> np.ndarray:
        """``[N]`` rad, counter-clockwise, not wrapped."""
        return self._engine.pose[1]

    @property
    def angular_velocity(self) -> np.ndarray:
        """``[N]`` rad/s."""
        return self._engine.twist[1]

    @property
    def touching_pairs(self) -> frozenset[Pair]:
        """The pairs, lower index first, that were in contact in the last substep.

        A pair that is joined has no contact: its joint takes all the force.
        """
        return frozenset(self._engine.touching)

    @property
    def joined_pairs(self) -> frozenset[Pair]:
        """The pairs, lower index first, that are joined."""
        return frozenset(self._joined)

    @property
    def holding(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: `joined_pairs`."""
        return self._matrix(self._joined)

    @property
    def contact(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: pairs that are joined, or touched during the last step.

        A bounce lasts for one substep: at the end of a step most are over.
        """
        return self._matrix(self._touched | self._joined)

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[N, 2]`` N on the bodies' middles."""
        self._keep("step", np.array(force, dtype=np.float64))
        self._touched = set()
        self._under_rule = True
        for _ in range(self._substeps):
            self._engine.advance(force)
            self._touched |= self._engine.touching
            if self.hold is not None:
                self.hold.update(self, self._substep_time)
        self._under_rule = False

    def join(self, first: int, second: int) -> None:
        """Ties two bodies together where they are, from the next substep on, if they are not yet.

        The joint is a pin, which leaves two bodies that cannot rotate no relative motion and lets a
        disc turn with a door. It is at the centre of a body that cannot rotate, the first if both
        cannot, else halfway between the origins of the two (a hinged body's is its hinge).
        """
        pair = min(first, second), max(first, second)
        if pair not in self._joined:
            self._keep("join", *pair)
            self._engine.join(pair)
            self._joined.add(pair)

    def part(self, first: int, second: int) -> None:
        """Ends what `join` has made; without effect on a pair that is not joined."""
        pair = min(first, second), max(first, second)
        if pair in self._joined:
            self._keep("part", *pair)
            self._engine.part(pair)
            self._joined.discard(pair)

    def joint_force(self, first: int, second: int) -> np.ndarray:
        """``[2]`` N, of the joint of a pair on its node of the higher index in the last substep.

        Zeros where there is none.
        """
        pair = min(first, second), max(first, second)
        return self._engine.joint_force(pair) if pair in self._joined else np.zeros(2)

    def joint_tension(self, first: int, second: int) -> float:
        """That force along the line between the middles of a joined pair, N; pulling: above 0."""
        position = self.position
        apart = position[min(first, second)] - position[max(first, second)]
        return float(apart @ self.joint_force(first, second) / np.linalg.norm(apart))

    def __deepcopy__(self, memo: dict[int, Any]) -> "PlanarWorld":
        """A world in the same state, by all calls made again: no engine can be copied to the bit.

        pymunk's copies lose the impulses with which joints and contacts begin their next step.
        """
        bodies, dt, substeps, hold, walls, engine = self._arguments
        other = PlanarWorld(bodies, dt, substeps, copy.deepcopy(hold), walls, engine)
        for switch, name, arguments in self._calls:
            other.switch = switch
            getattr(other, name)(*arguments)
        other.switch = self.switch
        return other

    def _keep(self, name: str, *arguments: Any) -> None:
        """Notes a call that is not a hold rule's, for a copy."""
        if not self._under_rule:
            self._calls.append((self.switch, name, arguments))

    def _matrix(self, pairs: Iterable[Pair]) -> np.ndarray:
        matrix = np.zeros((self._count, self._count), dtype=bool)
        for first, second in pairs:
            matrix[first, second] = matrix[second, first] = True
        return matrix


def engine_name(name: str | None = None) -> str:
    """The engine of a name; None: the first that is installed. Imports none.

    Raises `InvalidInputError` for one that is unknown or not installed.
    """
    if name is not None and name not in ENGINES:
        raise InvalidInputError(f"engine must be one of {', '.join(ENGINES)}, found {name!r}")
    for engine in ENGINES if name is None else (name,):
        if find_spec(ENGINES[engine]) is not None:
            return engine
    if name is None:
        raise InvalidInputError("planar tasks need box2d or pymunk: pip install pymunk")
    where = " (Python 3.13 at most, not Linux on ARM)" if name == "box2d" else ""
    raise InvalidInputError(f"engine {name} is not installed: pip install {name}{where}")
