"""Circles on Box2D that collide inelastically and then stick. Only this file imports Box2D.

Box2D detects the contacts, integrates the motion and carries the joints. The perfectly inelastic
impact is resolved here: within a substep a body moves in a straight line, so the time of impact is
a root of a quadratic. The bodies are moved back to it and continue together, with momentum over
mass as their common velocity, so a touching pair stays at exactly the sum of its radii.
"""

import warnings

import numpy as np

from contactgraph.data.errors import InvalidInputError

with warnings.catch_warnings():
    # Its wrapper warns of a deprecation on import and crashes if warnings are errors.
    warnings.simplefilter("ignore", DeprecationWarning)
    import Box2D as Box2D

SIMULATOR = f"box2d {Box2D.__version__}"

VELOCITY_ITERATIONS = 20
POSITION_ITERATIONS = 5


class TouchListener(Box2D.b2ContactListener):
    """Records pairs that begin to touch; the world is locked then, so it may do no more."""

    def __init__(self) -> None:
        super().__init__()
        self.touched: list[tuple[int, int]] = []

    def BeginContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, hence the name."""
        pair = sorted((contact.fixtureA.body.userData, contact.fixtureB.body.userData))
        self.touched.append((pair[0], pair[1]))


_ROUNDING = 1e-6
"""Tolerance for contacts that Box2D's single precision reports too early, m."""


class CircleWorld:
    """``N`` circles without gravity, friction, restitution or rotation.

    ``position`` ``[N, 2]`` m, ``mass`` ``[N]`` kg, ``radius`` ``[N]`` m; ``dt`` s is the time a
    call of `step` takes, in ``substeps`` equal parts. All start at rest. State is float32 inside.
    """

    def __init__(
        self,
        position: np.ndarray,
        mass: np.ndarray,
        radius: np.ndarray,
        dt: float,
        substeps: int = 10,
    ) -> None:
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        self._substeps = substeps
        self._substep_time = dt / substeps
        self._mass = np.asarray(mass, dtype=np.float64)
        self._radius = np.asarray(radius, dtype=np.float64)
        self._listener = TouchListener()  # Box2D does not keep it alive: we must
        self._world = Box2D.b2World(gravity=(0.0, 0.0), contactListener=self._listener)
        # A force acts over the whole step, not over its first substep only.
        self._world.autoClearForces = False
        self._bodies = [
            self._circle(index, centre, float(self._mass[index]), float(self._radius[index]))
            for index, centre in enumerate(np.asarray(position, dtype=np.float64))
        ]
        count = len(self._bodies)
        self._contact = np.zeros((count, count), dtype=bool)
        self._group = [{index} for index in range(count)]

    def _circle(self, index: int, centre: np.ndarray, mass: float, radius: float) -> Box2D.b2Body:
        fixture = Box2D.b2FixtureDef(
            shape=Box2D.b2CircleShape(radius=radius), density=1.0, friction=0.0, restitution=0.0
        )
        body = self._world.CreateDynamicBody(
            position=(float(centre[0]), float(centre[1])),
            fixedRotation=True,
            fixtures=fixture,
            # Below 1 cm/s Box2D would stop it after half a second; the world's own setting for
            # that has no effect.
            allowSleep=False,
        )
        # Density times area is not the mass to the last bit.
        body.massData = Box2D.b2MassData(mass=mass, center=(0.0, 0.0), I=0.0)
        body.userData = index
        return body

    @property
    def position(self) -> np.ndarray:
        """``[N, 2]`` m."""
        return np.array([tuple(body.position) for body in self._bodies])

    @property
    def velocity(self) -> np.ndarray:
        """``[N, 2]`` m/s."""
        return np.array([tuple(body.linearVelocity) for body in self._bodies])

    @property
    def contact(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric, zero diagonal: pairs that touched, and stick since."""
        return self._contact.copy()

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[N, 2]`` N."""
        for body, (x, y) in zip(self._bodies, force.tolist(), strict=True):
            if x or y:
                body.ApplyForceToCenter((x, y), True)
        for _ in range(self._substeps):
            self._world.Step(self._substep_time, VELOCITY_ITERATIONS, POSITION_ITERATIONS)
            # Box2D looks for touches when a step begins. A step of no time looks and does no
            # more, so that a touch in the last substep is not left to the next control step.
            self._world.Step(0.0, 0, 0)
            while self._listener.touched:
                self._join_touching()
                self._world.Step(0.0, 0, 0)
        self._world.ClearForces()

    def _join_touching(self) -> None:
        """Joins the pairs noted by the listener, first touch first."""
        pairs, self._listener.touched = self._listener.touched, []
        for first, second in sorted(pairs, key=lambda pair: -self._time_since_touch(*pair)):
            if second in self._group[first]:
                self._hold(first, second)
            elif self._overlap(first, second) >= -_ROUNDING:  # else an earlier one parted them
                self._collide(first, second)
                self._hold(first, second)

    def _collide(self, first: int, second: int) -> None:
        """The purely inelastic impact of the two groups, at the moment of their touch."""
        elapsed = self._time_since_touch(first, second)
        groups = (self._group[first], self._group[second])
        together = groups[0] | groups[1]
        common = self._group_velocity(together)
        for group in groups:
            shift = elapsed * (common - self._group_velocity(group))
            for index in group:
                body = self._bodies[index]
                body.position = body.position + Box2D.b2Vec2(*shift.tolist())
        for index in together:
            self._bodies[index].linearVelocity = common.tolist()
            self._group[index] = together

    def _hold(self, first: int, second: int) -> None:
        body_a, body_b = self._bodies[first], self._bodies[second]
        # Between bodies that cannot rotate a revolute joint holds rigidly; a weld does not.
        self._world.CreateRevoluteJoint(
            bodyA=body_a, bodyB=body_b, anchor=(body_a.position + body_b.position) * 0.5
        )
        self._contact[first, second] = self._contact[second, first] = True

    def _time_since_touch(self, first: int, second: int) -> float:
        """Time since the distance was the sum of the radii, within this substep; s."""
        offset = self._offset(first, second)
        closing = self._group_velocity(self._group[second]) - self._group_velocity(
            self._group[first]
        )
        speed_squared = float(closing @ closing)
        if speed_squared == 0.0:
            return 0.0
        along = float(offset @ closing)
        distance = float(self._radius[first] + self._radius[second])
        gap_squared = distance**2 - float(offset @ offset)
        root = np.sqrt(max(along**2 + speed_squared * gap_squared, 0.0))
        return float(np.clip((along + root) / speed_squared, 0.0, self._substep_time))

    def _overlap(self, first: int, second: int) -> float:
        distance = float(self._radius[first] + self._radius[second])
        return distance - float(np.linalg.norm(self._offset(first, second)))

    def _offset(self, first: int, second: int) -> np.ndarray:
        return np.array(tuple(self._bodies[second].position - self._bodies[first].position))

    def _group_velocity(self, group: set[int]) -> np.ndarray:
        members = sorted(group)  # a sum's order is part of a bit-identical episode
        mass = self._mass[members]
        velocity = np.array([tuple(self._bodies[index].linearVelocity) for index in members])
        return mass @ velocity / mass.sum()
