"""The map that tells the bodies, the control and the goal of a Gymnasium environment."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.contract import ChainCost

ContactReader = Callable[[gymnasium.Env[Any, Any]], np.ndarray]
"""Which bodies touched in the last step, ``[N, N]`` bool, as the environment's simulator says."""


@dataclass(frozen=True)
class Entries:
    """Entries ``start`` to ``stop - 1`` of an observation, or of the array under its ``key``."""

    start: int
    stop: int
    key: str | None = None

    @property
    def width(self) -> int:
        """The number of entries."""
        return self.stop - self.start

    def read(self, observation: Any) -> np.ndarray:
        """The entries of one observation, ``[width]``, in the environment's unit."""
        source = observation if self.key is None else observation[self.key]
        return np.asarray(source, dtype=np.float64).ravel()[self.start : self.stop]


@dataclass(frozen=True, eq=False)
class MappedBody:
    """One body of an environment, which becomes one node.

    Velocities that are not given are backward differences of the recorded poses, zero at the
    start: the position of a step is then exactly the one before plus ``dt`` times the velocity.
    """

    name: str
    type: str
    position: Entries
    """D entries."""
    velocity: Entries | None = None
    """D entries. None: backward differences."""
    orientation: Entries | tuple[float, ...] | None = None
    """In the plane one angle, rad; in space a unit quaternion (w, x, y, z), or three angles of
    ``euler``, rad. Numbers: a body that does not turn. None: no body of the map turns."""
    euler: str | None = None
    """The order of three angles in SciPy's notation: ``"XYZ"`` turns about the body's own axes."""
    angular_velocity: Entries | None = None
    """Rad/s: one entry in the plane, three in space. None: backward differences."""
    relative_to: str | None = None
    """The body to which the environment's position and velocity are relative. None: the world."""
    reference: tuple[float, ...] | None = None
    """[D] m, in the body's frame: the point that becomes the node's position, such as the centre
    of mass, where the environment observes another point. None: the observed point."""
    actuated: bool = False
    bounds: np.ndarray | None = None
    """[2, D] m: lower and upper corner of the table, or of an arm's reach. An episode ends where
    the body leaves them. None: none."""
    mass: float | None = None
    """kg."""
    radius: float | None = None
    """m."""
    size: tuple[float, ...] | None = None
    """[D] m: sides of a box."""
    polygons: tuple[np.ndarray, ...] = ()
    """Convex outlines ``[V, 2]`` m about ``reference``; in space points ``[V, 3]`` m, whose convex
    hulls they are, in the body's frame."""


@dataclass(frozen=True, eq=False)
class MappedControl:
    """The meaning of an environment's action.

    Component ``u`` of the control is ``scale * a + offset`` of the environment's action entry
    ``a``; further entries of the action stay at ``rest``.
    """

    kind: tuple[str, ...]
    """[U] `contactgraph.data.Scene.control_kind`."""
    body: tuple[str | None, ...]
    """[U] name of the body on which a component acts. None: on none."""
    entries: tuple[int, ...]
    """[U] indices of the environment's action."""
    scale: tuple[float, ...]
    """[U] SI unit of the component per unit of the action; not 0."""
    offset: tuple[float, ...] | None = None
    """[U] in the component's unit. None: zero."""
    rest: float = 0.0


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """All that an `AdaptedTask` needs to know of an environment. Lengths are in m after ``scale``.

    The shapes are compared with the environment's spaces where the task is made.
    """

    name: str
    """Of the task, for the metadata of recordings."""
    dt: float
    """Time of one step of the environment, s."""
    bodies: tuple[MappedBody, ...]
    control: MappedControl
    goal: Entries | tuple[float, ...]
    """Entries of the observation, or a fixed position ``[D]`` m."""
    cost: ChainCost
    """Its chain names bodies by their indices; the last one is to reach the goal."""
    max_steps: int
    tolerance: float | None = None
    """m: a final distance of the chain's last body to the goal that is a success."""
    success_key: str | None = None
    """The entry of the environment's ``info`` that says success, where there is no tolerance."""
    score_key: str | None = None
    """The entry of ``info`` that tells how well a step is, the more the better. None: there is
    none."""
    dimension: int = 2
    """D."""
    scale: float = 1.0
    """m per unit of the environment's lengths."""
    contact: ContactReader | None = None
    """None: bodies touch where their radii reach; every body then needs one."""
    planes: np.ndarray | None = None
    """[P, D+1] `contactgraph.data.Scene.planes`."""
    gravity: tuple[float, ...] | None = None
    """[D] m/s^2 `contactgraph.data.Scene.gravity`."""
    metadata: dict[str, str | int | float | bool] = field(default_factory=dict)

    @property
    def turns(self) -> bool:
        """Whether the bodies' orientations are known."""
        return any(body.orientation is not None for body in self.bodies)

    def index(self, name: str, what: str) -> int:
        """The index of a body's name; raises `InvalidInputError` without one."""
        names = [body.name for body in self.bodies]
        if name not in names:
            raise InvalidInputError(
                f"{self.name}: {what} must be one of {', '.join(names)}; found {name!r}"
            )
        return names.index(name)

    def check(self, environment: gymnasium.Env[Any, Any]) -> None:
        """Raises `InvalidInputError` where the map does not fit the environment's spaces."""
        self._check_bodies(environment.observation_space)
        if isinstance(self.goal, Entries):
            self._check_entries("goal", self.goal, environment.observation_space, self.dimension)
        elif len(self.goal) != self.dimension:
            self._fail(f"goal must have {self.dimension} numbers, found {self.goal}")
        self._check_control(environment.action_space)
        if (self.tolerance is None) == (self.success_key is None):
            self._fail("success needs a tolerance or a success_key, and not both")
        if max(self.cost.chain) >= len(self.bodies):
            self._fail(
                f"cost.chain must name bodies 0 to {len(self.bodies) - 1}, found {self.cost.chain}"
            )
        if self.contact is None:
            for body in self.bodies:
                if body.radius is None:
                    self._fail(f"{body.name} needs a radius, or the map a contact function")

    def _check_bodies(self, space: gymnasium.Space[Any]) -> None:
        if not any(body.actuated for body in self.bodies):
            self._fail("at least one body must be actuated, found none")
        for body in self.bodies:
            turning = 1 if self.dimension == 2 else 3
            pose = turning if self.dimension == 2 or body.euler else 4
            wanted = (
                ("position", body.position, self.dimension),
                ("velocity", body.velocity, self.dimension),
                ("orientation", body.orientation, pose),
                ("angular_velocity", body.angular_velocity, turning),
            )
            for field_name, entries, width in wanted:
                what = f"{body.name}.{field_name}"
                if isinstance(entries, Entries):
                    self._check_entries(what, entries, space, width)
                elif entries is not None and len(entries) != width:
                    self._fail(f"{what} must have {width} numbers, found {entries}")
            if self.turns and body.orientation is None:
                self._fail(f"{body.name}.orientation must be known, as another body's is")
            if body.relative_to is not None:
                where = self.index(body.relative_to, f"{body.name}.relative_to")
                if self.bodies[where].relative_to is not None:
                    self._fail(f"{body.name}.relative_to must be a body in world coordinates")
            if body.reference is not None and not self.turns:
                self._fail(f"{body.name}.reference needs an orientation")
            if body.bounds is not None and np.shape(body.bounds) != (2, self.dimension):
                self._fail(f"{body.name}.bounds must have shape (2, {self.dimension})")

    def _check_entries(
        self, what: str, entries: Entries, space: gymnasium.Space[Any], width: int
    ) -> None:
        keys = list(space.spaces) if isinstance(space, gymnasium.spaces.Dict) else []
        if entries.key is not None and entries.key not in keys:
            valid = f"one of {', '.join(keys)}" if keys else "None (the observation is an array)"
            self._fail(f"{what}: key must be {valid}; found {entries.key!r}")
        if entries.key is None and keys:
            self._fail(f"{what}: key must be one of {', '.join(keys)}; found None")
        source = space if entries.key is None else space[entries.key]  # type: ignore[index]
        size = int(np.prod(source.shape or (1,)))
        if not 0 <= entries.start < entries.stop <= size:
            self._fail(
                f"{what}: entries {entries.start} to {entries.stop - 1} must lie in 0 to {size - 1}"
            )
        if entries.width != width:
            self._fail(f"{what} must have {width} entries, found {entries.width}")

    def _check_control(self, space: gymnasium.Space[Any]) -> None:
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise InvalidInputError(
                f"map of {self.name}: the environment's action_space must be a Box of shape (U,), "
                f"found {space}"
            )
        control, count = self.control, len(self.control.kind)
        lengths = (control.body, control.entries, control.scale, control.offset or control.scale)
        if any(len(each) != count for each in lengths):
            self._fail(f"control: body, entries, scale and offset must have {count} values each")
        for name in control.body:
            if name is not None:
                self.index(name, "control.body")
        size = space.shape[0]
        if any(not 0 <= entry < size for entry in control.entries):
            self._fail(f"control.entries must lie in 0 to {size - 1}, found {control.entries}")
        box = space.low[list(control.entries)], space.high[list(control.entries)]
        if not np.isfinite(box).all():
            self._fail("the environment's action_space must be bounded")
        if 0.0 in control.scale:
            self._fail("control.scale must not be 0")

    def _fail(self, message: str) -> None:
        raise InvalidInputError(f"map of {self.name}: {message}")
