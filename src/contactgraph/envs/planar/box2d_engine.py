"""Bodies in Box2D, the paper's engine. Only this file imports it.

Impacts happen at the time of impact of its continuous collision detection.

Lengths are `SCALE` times larger inside. Box2D is made for bodies of 0.1 to 10 m, and its constants
are lengths: bodies that approach at less than 1 m/s do not bounce (b2_velocityThreshold), touching
bodies overlap by 5 to 15 mm (b2_linearSlop), polygons have a skin of 10 mm. Here these are 3.1
cm/s, 0.16 to 0.47 mm, and 0.3 mm, of which the skin is part of the given shape. No body moves by
more than 0.0625 m a substep (12.5 m/s with ten substeps of a step of 0.05 s). State is float32.

Energy does not grow in a touch of two bodies. Where several touch at once, with friction *and* a
restitution of 1, the solver adds some (1.5 % among 16 discs in a box; none at 0.9).
"""

import warnings
from collections.abc import Sequence

import numpy as np

from contactgraph.envs.planar.body import GRAVITY, PlanarBody
from contactgraph.envs.planar.world import Pair

with warnings.catch_warnings():
    # Its wrapper warns of a deprecation on import and crashes if warnings are errors.
    warnings.simplefilter("ignore", DeprecationWarning)
    import Box2D as Box2D

SCALE = 32.0
"""Box2D's unit of length, 1/m; a power of two, so that it rounds nothing."""

_VELOCITY_ITERATIONS = 20
_POSITION_ITERATIONS = 10
_SKIN = float(Box2D.b2_polygonRadius) / SCALE
"""Box2D surrounds every polygon and edge by a skin of this radius, m."""
_HINGE_MASS = 1e12
"""kg; no force of a contact moves so heavy a body in single precision."""


class _ContactListener(Box2D.b2ContactListener):
    """Keeps the set of touching pairs; the world is locked then, so it may do no more."""

    def __init__(self) -> None:
        super().__init__()
        self.pairs: set[Pair] = set()

    def BeginContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, hence the name."""
        pair = _pair(contact)
        if pair[0] >= 0:  # else a wall, which is no node
            self.pairs.add(pair)

    def EndContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, also where a joint takes the place of a contact."""
        self.pairs.discard(_pair(contact))


class Box2DEngine:
    """An `Engine`; ``time`` s is a substep's."""

    simulator = f"box2d {Box2D.__version__}"

    def __init__(self, bodies: Sequence[PlanarBody], time: float, walls: np.ndarray | None) -> None:
        self._time = time
        self._listener = _ContactListener()  # Box2D does not keep it alive: we must
        self._world = Box2D.b2World(gravity=(0.0, 0.0), contactListener=self._listener)
        self._descriptions = tuple(bodies)
        self._static = np.array([body.static for body in bodies])
        self._start = np.array([body.position for body in bodies], dtype=np.float64)
        self._middles = [_inside(body.arm) for body in bodies]
        self._bodies = [self._create(index, body) for index, body in enumerate(bodies)]
        self._joints: dict[Pair, Box2D.b2Joint] = {}
        if walls is not None:
            self._wall_in(walls + np.array([[-_SKIN], [_SKIN]]))

    @property
    def touching(self) -> set[Pair]:
        """See `Engine`."""
        return self._listener.pairs

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
                groupIndex=body.group,
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
        if not fixed:
            created.angularVelocity = body.spin
        return created

    def _wall_in(self, corners: np.ndarray) -> None:
        """Four walls, number -1; ``corners`` ``[2, 2]`` m: the lower and the upper."""
        (left, low), (right, high) = (corners * SCALE).tolist()
        points = [(left, low), (right, low), (right, high), (left, high)]
        body = self._world.CreateStaticBody(userData=-1)
        for ends in zip(points, points[1:] + points[:1], strict=True):
            body.CreateEdgeFixture(vertices=ends, friction=0.0, restitution=0.0)

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        ends = zip(self._bodies, self._middles, strict=True)
        places = [body.GetWorldPoint(middle) for body, middle in ends]
        moved = np.array([tuple(place) for place in places]) / SCALE
        # Box2D shifts a static body by rounding each time that it is struck.
        position = np.where(self._static[:, None], self._start, moved)
        return position, np.array([body.angle for body in self._bodies])

    @property
    def twist(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        ends = zip(self._bodies, self._middles, strict=True)
        speeds = [body.GetLinearVelocityFromLocalPoint(middle) for body, middle in ends]
        velocity = np.array([tuple(speed) for speed in speeds]) / SCALE
        return velocity, np.array([body.angularVelocity for body in self._bodies])

    def advance(self, force: np.ndarray) -> None:
        """See `Engine`."""
        for index, (x, y) in enumerate(force.tolist()):
            body = self._bodies[index]
            if self._descriptions[index].ground_friction:
                self._slide(index, x, y)
            elif x or y:
                point = body.GetWorldPoint(self._middles[index])
                body.ApplyForce((x * SCALE, y * SCALE), point, True)
        self._world.Step(self._time, _VELOCITY_ITERATIONS, _POSITION_ITERATIONS)

    def join(self, pair: Pair) -> None:
        """See `Engine`."""
        one, other = (self._bodies[index] for index in pair)
        upright = [body for body in (one, other) if body.fixedRotation and body.mass > 0.0]
        anchor = upright[0].position if upright else (one.position + other.position) * 0.5
        self._joints[pair] = self._world.CreateRevoluteJoint(bodyA=one, bodyB=other, anchor=anchor)

    def part(self, pair: Pair) -> None:
        """See `Engine`."""
        self._world.DestroyJoint(self._joints.pop(pair))
        for fixture in self._bodies[pair[0]].fixtures:
            fixture.Refilter()  # else Box2D looks for their contact only once one moves away

    def joint_force(self, pair: Pair) -> np.ndarray:
        """See `Engine`."""
        force = self._joints[pair].GetReactionForce(1.0 / self._time)
        return np.array([force.x, force.y]) / SCALE

    def _slide(self, index: int, x: float, y: float) -> None:
        """The velocity of a body on the ground under a force (N) after one substep.

        The deceleration is constant and ends in rest: friction takes no more than all the speed.
        """
        body, description = self._bodies[index], self._descriptions[index]
        impulse = SCALE * self._time / description.mass
        vx, vy = body.linearVelocity.x + x * impulse, body.linearVelocity.y + y * impulse
        speed = float(np.hypot(vx, vy))
        lost = description.ground_friction * GRAVITY * self._time * SCALE
        keep = 1.0 - lost / speed if speed > lost else 0.0
        body.linearVelocity = (keep * vx, keep * vy)


ENGINE = Box2DEngine


def _pair(contact: Box2D.b2Contact) -> Pair:
    one, other = contact.fixtureA.body.userData, contact.fixtureB.body.userData
    return min(one, other), max(one, other)


def _inside(place: np.ndarray) -> tuple[float, float]:
    """A length ``[2]`` m, or a speed, in Box2D's units."""
    return float(place[0]) * SCALE, float(place[1]) * SCALE
