"""Bodies in the plane on Box2D: its contacts, its impacts, its joints. Only this file imports it.

Box2D resolves a touch itself: impulses by its sequential solver, with restitution and Coulomb
friction, at the time of impact of its continuous collision detection. A `HoldRule` looks at the
world after every substep and may tie bodies together or part them; a joint takes effect from the
next substep on. A touch in the last substep of a step is therefore recorded with an impact that is
not complete: what the joint adds to the contact (the relative velocity along the surfaces becomes
zero, and bodies behind the struck one feel the blow) follows in the next step.

Lengths are `SCALE` times larger inside. Box2D is made for bodies of 0.1 to 10 m, and its constants
are lengths: bodies that approach at less than 1 m/s do not bounce (b2_velocityThreshold), touching
bodies overlap by 5 to 15 mm (b2_linearSlop), polygons have a skin of 10 mm. Here these are 3.1
cm/s, 0.16 to 0.47 mm, and 0.3 mm, of which the skin is part of the given shape. No body moves by
more than 0.0625 m a substep (12.5 m/s with ten substeps of a step of 0.05 s).

Energy does not grow in a touch of two bodies. Where several touch at once, with friction *and* a
restitution of 1, the solver adds some (1.5 % among 16 discs in a box; none at 0.9).
"""

import warnings
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.envs.planar_body import PlanarBody
from contactgraph.envs.planar_joints import (
    Pad,
    bounds_of_reach,
    joints_between,
    total_force,
    walls_around,
)

with warnings.catch_warnings():
    # Its wrapper warns of a deprecation on import and crashes if warnings are errors.
    warnings.simplefilter("ignore", DeprecationWarning)
    import Box2D as Box2D

SIMULATOR = f"box2d {Box2D.__version__}"
GRAVITY = 9.81
"""m/s^2, of the friction with the ground."""
SCALE = 32.0
"""Box2D's unit of length, 1/m; a power of two, so that it rounds nothing."""

_VELOCITY_ITERATIONS = 20
_POSITION_ITERATIONS = 10
_SKIN = float(Box2D.b2_polygonRadius) / SCALE
"""Box2D surrounds every polygon and edge by a skin of this radius, m."""
_HINGE_MASS = 1e12
"""kg; no force of a contact moves so heavy a body in single precision."""


class HoldRule(Protocol):
    """Decides which bodies are tied together."""

    def reset(self, world: "PlanarWorld") -> None:
        """Called once, before the first step."""

    def update(self, world: "PlanarWorld", dt: float) -> None:
        """Called after every substep of ``dt`` s; may call ``world.join`` and ``world.part``."""


class _ContactListener(Box2D.b2ContactListener):
    """Keeps the set of touching pairs; the world is locked then, so it may do no more."""

    def __init__(self) -> None:
        super().__init__()
        self.pairs: set[tuple[int, int]] = set()

    def BeginContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, hence the name."""
        pair = _pair(contact)
        if pair[0] >= 0:  # else a wall, which is no node
            self.pairs.add(pair)
        elif pair[0] < -1:  # a bound of reach: else the body's restitution counts, the larger one
            contact.restitution = 0.0

    def EndContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, also where a joint takes the place of a contact."""
        self.pairs.discard(_pair(contact))


class PlanarWorld:
    """``N`` bodies in the plane, without gravity in it.

    ``dt`` s is the time a call of `step` takes, in ``substeps`` equal parts. ``hold`` ties bodies
    together; None: nothing does. ``walls`` ``[2, 2]`` m are the lower and the upper corner of four
    walls without friction around the bodies; None: none. State is float32 inside. Raises
    `InvalidInputError` for numbers out of range.
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
    ) -> None:
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        self._substeps = substeps
        self._substep_time = dt / substeps
        self._listener = _ContactListener()  # Box2D does not keep it alive: we must
        self._world = Box2D.b2World(gravity=(0.0, 0.0), contactListener=self._listener)
        self._descriptions = tuple(bodies)
        self._static = np.array([body.static for body in bodies])
        self._start = np.array([body.position for body in bodies], dtype=np.float64)
        self._middles = [_inside(body.arm) for body in bodies]
        self._bodies = [self._create(index, body) for index, body in enumerate(bodies)]
        self._joints: dict[tuple[int, int], list[Box2D.b2Joint]] = {}
        self._touched: set[tuple[int, int]] = set()
        if walls is not None:
            walls_around(self._world, walls + np.array([[-_SKIN], [_SKIN]]), SCALE)
        self._hold = hold
        if hold is not None:
            hold.reset(self)

    def _create(self, index: int, body: PlanarBody) -> Box2D.b2Body:
        hinged = body.anchor is not None
        fixed = body.static or not (hinged or body.rotates)
        middle = self._middles[index]
        if body.radius is not None:
            shape = Box2D.b2CircleShape(radius=body.radius * SCALE, pos=middle)
        else:
            half = _inside(np.asarray(body.half_size) - _SKIN)
            shape = Box2D.b2PolygonShape(box=(*half, middle, 0.0))
        create = self._world.CreateStaticBody if body.static else self._world.CreateDynamicBody
        created = create(
            position=_inside(body.position if body.anchor is None else body.anchor),
            angle=float(body.angle),
            linearVelocity=(0.0, 0.0) if hinged or body.static else _inside(body.velocity),
            linearDamping=body.damping,
            angularDamping=body.damping,
            fixedRotation=fixed,
            allowSleep=False,  # else Box2D stops slow bodies; the world's own setting does nothing
            bullet=not body.static,  # else a fast body is struck only once it overlaps another
            fixtures=Box2D.b2FixtureDef(
                shape=shape,
                density=1.0,
                friction=body.friction,
                restitution=body.restitution,
                groupIndex=body.group if body.reach is None else index + 1,
            ),
        )
        created.userData = index
        if not body.static:
            # Density times area is not the mass to the last bit. A hinged body is one whose centre
            # of mass is its hinge: held there by a joint, it would lose speed in each substep.
            created.massData = Box2D.b2MassData(
                mass=_HINGE_MASS if hinged else body.mass,
                center=(0.0, 0.0),
                I=0.0 if fixed else body.inertia * SCALE**2,
            )
        if hinged:
            created.angularVelocity = body.spin
        if body.reach is not None:
            distance = float(body.size[0]) + _SKIN
            bounds_of_reach(self._world, body.reach, distance, index + 1, SCALE)
        return created

    @property
    def position(self) -> np.ndarray:
        """``[N, 2]`` m, of the bodies' middles."""
        ends = zip(self._bodies, self._middles, strict=True)
        places = [body.GetWorldPoint(middle) for body, middle in ends]
        moved = np.array([tuple(place) for place in places]) / SCALE
        # Box2D shifts a static body by rounding each time that it is struck.
        return np.where(self._static[:, None], self._start, moved)

    @property
    def velocity(self) -> np.ndarray:
        """``[N, 2]`` m/s of the same points."""
        ends = zip(self._bodies, self._middles, strict=True)
        speeds = [body.GetLinearVelocityFromLocalPoint(middle) for body, middle in ends]
        return np.array([tuple(speed) for speed in speeds]) / SCALE

    @property
    def angle(self) -> np.ndarray:
        """``[N]`` rad, counter-clockwise, not wrapped."""
        return np.array([body.angle for body in self._bodies])

    @property
    def angular_velocity(self) -> np.ndarray:
        """``[N]`` rad/s."""
        return np.array([body.angularVelocity for body in self._bodies])

    @property
    def touching_pairs(self) -> frozenset[tuple[int, int]]:
        """The pairs, lower index first, that Box2D had in contact in the last substep.

        A pair that is joined has no contact: its joint takes all the force.
        """
        return frozenset(self._listener.pairs)

    @property
    def touching(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: `touching_pairs`."""
        return self._matrix(self._listener.pairs)

    @property
    def holding(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: pairs that are joined."""
        return self._matrix(self._joints)

    @property
    def contact(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: pairs that are joined, or touched during the last step.

        A bounce lasts for one substep: at the end of a step most are over.
        """
        return self._matrix(self._touched) | self.holding

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[N, 2]`` N on the bodies' middles."""
        self._touched = set()
        for _ in range(self._substeps):
            self._push(force)
            self._world.Step(self._substep_time, _VELOCITY_ITERATIONS, _POSITION_ITERATIONS)
            self._touched |= self._listener.pairs
            if self._hold is not None:
                self._hold.update(self, self._substep_time)

    def join(self, first: int, second: int, pad: Pad | None = None) -> None:
        """Ties two bodies together where they are, from the next substep on, if they are not yet.

        The joint is a pin, which leaves two discs that cannot rotate no relative motion and lets a
        disc turn with a door; or a soft ``pad`` between two such discs.
        """
        pair = min(first, second), max(first, second)
        if pair not in self._joints:
            ends = [self._bodies[index] for index in pair]
            self._joints[pair] = joints_between(self._world, ends, pad, SCALE)

    def part(self, first: int, second: int) -> None:
        """Ends what `join` has made; without effect on a pair that is not joined."""
        joints = self._joints.pop((min(first, second), max(first, second)), [])
        for joint in joints:
            self._world.DestroyJoint(joint)
        if joints:
            for fixture in self._bodies[first].fixtures:
                fixture.Refilter()  # else Box2D looks for their contact only once one moves away

    def joint_force(self, first: int, second: int) -> float:
        """The force that the joint of a pair has carried in the last substep, N; 0: no joint."""
        return float(np.linalg.norm(self._joint_force(first, second)))

    def joint_tension(self, first: int, second: int) -> float:
        """That force along the line between the middles of a joined pair, N; pulling: above 0."""
        apart = self.position[min(first, second)] - self.position[max(first, second)]
        return float(apart @ self._joint_force(first, second) / np.linalg.norm(apart))

    def _joint_force(self, first: int, second: int) -> np.ndarray:
        """[2] N, on the body of a pair with the higher index."""
        joints = self._joints.get((min(first, second), max(first, second)), [])
        return total_force(joints, 1.0 / self._substep_time) / SCALE

    def _push(self, force: np.ndarray) -> None:
        """Applies forces, and the friction with the ground, for one substep."""
        for index, (x, y) in enumerate(force.tolist()):
            body = self._bodies[index]
            if self._descriptions[index].ground_friction:
                self._slide(index, x, y)
            elif x or y:
                point = body.GetWorldPoint(self._middles[index])
                body.ApplyForce((x * SCALE, y * SCALE), point, True)

    def _slide(self, index: int, x: float, y: float) -> None:
        """The velocity of a body on the ground under a force (N) after one substep.

        The deceleration is constant and ends in rest: friction takes no more than all the speed.
        """
        body, description = self._bodies[index], self._descriptions[index]
        impulse = SCALE * self._substep_time / description.mass
        vx, vy = body.linearVelocity.x + x * impulse, body.linearVelocity.y + y * impulse
        speed = float(np.hypot(vx, vy))
        lost = description.ground_friction * GRAVITY * self._substep_time * SCALE
        keep = 1.0 - lost / speed if speed > lost else 0.0
        body.linearVelocity = (keep * vx, keep * vy)

    def _matrix(self, pairs: Iterable[tuple[int, int]]) -> np.ndarray:
        matrix = np.zeros((len(self._bodies),) * 2, dtype=bool)
        for first, second in pairs:
            matrix[first, second] = matrix[second, first] = True
        return matrix


def _pair(contact: Box2D.b2Contact) -> tuple[int, int]:
    one, other = contact.fixtureA.body.userData, contact.fixtureB.body.userData
    return min(one, other), max(one, other)


def _inside(place: np.ndarray) -> tuple[float, float]:
    """A length ``[2]`` m, or a speed, in Box2D's units."""
    return float(place[0]) * SCALE, float(place[1]) * SCALE
