"""A gripper among hinged doors: its first impact is purely inelastic and pins it to that door.

Box2D detects the contact and integrates the motion; the impact is resolved here, at the moment of
touch. Within a substep the gripper moves in a straight line and a door turns at a constant rate,
so that moment is the root of a distance. The two are moved back to it and continue as one body,
whose angular velocity about the hinge is what conserves the angular momentum about it.

A door is a body whose centre of mass *is* its hinge, with the door's inertia about the hinge: the
one degree of freedom that it has, and exact. Were its centre of mass the bar's middle, held by a
joint, that joint would bend a straight step into an arc and take away some of the spin each time
(at 2 rad/s and 5 ms, 0.7 % a second).
"""

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.envs.circle_world import (
    POSITION_ITERATIONS,
    VELOCITY_ITERATIONS,
    Box2D,
    TouchListener,
)

GRIPPER = 0

_SKIN = 0.01
"""Box2D surrounds every polygon by a skin of this radius, m; here it is the door's surface."""
_HALVINGS = 40
"""Bisection steps for the time of impact in a substep: beyond double precision."""


class DoorWorld:
    """A gripper, which cannot rotate, and ``M`` doors, each a bar hinged at one end. No gravity.

    Node 0 is the gripper, a circle of ``gripper_radius`` m and ``gripper_mass`` kg at
    ``gripper`` ``[2]`` m. Nodes 1 to M are the doors: bars ``length`` by ``thickness`` m with
    slightly rounded corners, of ``door_mass`` kg, whose middle is half a length from its
    ``hinge`` ``[M, 2]`` m in the direction ``angle`` ``[M]`` rad. ``dt`` s is the time a call of
    `step` takes, in ``substeps`` equal parts. All start at rest. State is float32 inside.

    The gripper is tied to the first door that it touches and meets no other from then on. Doors
    do not touch one another.
    """

    def __init__(
        self,
        gripper: np.ndarray,
        hinge: np.ndarray,
        angle: np.ndarray,
        *,
        gripper_mass: float,
        gripper_radius: float,
        door_mass: float,
        length: float,
        thickness: float,
        dt: float,
        substeps: int = 10,
    ) -> None:
        if substeps < 1:
            raise InvalidInputError(f"substeps must be at least 1, found {substeps}")
        self._substeps = substeps
        self._substep_time = dt / substeps
        self._gripper_mass = gripper_mass
        self._reach = gripper_radius + _SKIN
        self._middle = 0.5 * length
        self._inner = np.array([0.5 * length - _SKIN, 0.5 * thickness - _SKIN])
        # About one end: that of a box about its middle, and the middle's distance to the hinge.
        self._door_inertia = door_mass * ((length**2 + thickness**2) / 12.0 + self._middle**2)
        self._hinge = np.asarray(hinge, dtype=np.float64)
        self._listener = TouchListener()  # Box2D does not keep it alive: we must
        self._world = Box2D.b2World(gravity=(0.0, 0.0), contactListener=self._listener)
        self._gripper: Box2D.b2Body | None = self._world.CreateDynamicBody(
            position=(float(gripper[0]), float(gripper[1])),
            fixedRotation=True,
            allowSleep=False,
            fixtures=Box2D.b2FixtureDef(
                shape=Box2D.b2CircleShape(radius=gripper_radius), density=1.0
            ),
        )
        self._gripper.massData = Box2D.b2MassData(mass=gripper_mass, center=(0.0, 0.0), I=0.0)
        self._gripper.userData = GRIPPER
        self._doors = [
            self._door(index + 1, hinge, float(turned), door_mass)
            for index, (hinge, turned) in enumerate(zip(self._hinge, angle, strict=True))
        ]
        self._held = 0
        """The door that the gripper is pinned to; 0: none."""
        self._pin = np.zeros(2)
        """[2] m: the gripper's position in the frame of that door."""

    def _door(self, index: int, hinge: np.ndarray, angle: float, mass: float) -> Box2D.b2Body:
        half_length, half_thickness = (float(half) for half in self._inner)
        bar = Box2D.b2PolygonShape(box=(half_length, half_thickness, (self._middle, 0.0), 0.0))
        body = self._world.CreateDynamicBody(
            position=(float(hinge[0]), float(hinge[1])),
            angle=angle,
            # Below 1 cm/s Box2D would stop it after half a second; the world's own setting for
            # that has no effect.
            allowSleep=False,
            # Doors of one negative group do not meet one another.
            fixtures=Box2D.b2FixtureDef(shape=bar, density=1.0, groupIndex=-1),
        )
        body.massData = Box2D.b2MassData(mass=mass, center=(0.0, 0.0), I=self._door_inertia)
        body.userData = index
        return body

    @property
    def position(self) -> np.ndarray:
        """``[1 + M, 2]`` m: the gripper's centre, and the middle of each door."""
        middles = [self._hinge[i] + self._arm(door) for i, door in enumerate(self._doors)]
        return np.array([self._gripper_position(), *middles])

    @property
    def velocity(self) -> np.ndarray:
        """``[1 + M, 2]`` m/s of the same points."""
        middles = [door.angularVelocity * _left(self._arm(door)) for door in self._doors]
        return np.array([self._gripper_velocity(), *middles])

    @property
    def contact(self) -> np.ndarray:
        """``[1 + M, 1 + M]`` bool, symmetric: the gripper and the door that it is pinned to."""
        contact = np.zeros((1 + len(self._doors),) * 2, dtype=bool)
        if self._held:
            contact[GRIPPER, self._held] = contact[self._held, GRIPPER] = True
        return contact

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[1 + M, 2]`` N on the nodes."""
        for _ in range(self._substeps):
            self._push(force)
            self._world.Step(self._substep_time, VELOCITY_ITERATIONS, POSITION_ITERATIONS)
            # Box2D looks for touches when a step begins. A step of no time looks and does no
            # more, so that a touch in the last substep is not left to the next control step.
            self._world.Step(0.0, 0, 0)
            if self._listener.touched:
                self._catch()

    def _push(self, force: np.ndarray) -> None:
        """Applies forces for one substep: on doors as torques."""
        for index, door in enumerate(self._doors, start=1):
            torque = _cross(self._arm(door), force[index])
            if index == self._held:
                torque += _cross(_turned(self._pin, door.angle), force[GRIPPER])
            if torque:
                door.ApplyTorque(torque, True)
        if self._gripper is not None:
            self._gripper.ApplyForceToCenter(
                (float(force[GRIPPER, 0]), float(force[GRIPPER, 1])), True
            )

    def _catch(self) -> None:
        """The purely inelastic impact with the door that was touched first, and the pin."""
        touched = {max(pair) for pair in self._listener.touched}
        self._listener.touched = []
        elapsed, held = max((self._time_since_touch(index), index) for index in sorted(touched))
        door = self._doors[held - 1]
        rate = door.angularVelocity
        angle = door.angle - elapsed * rate
        velocity = self._gripper_velocity()
        arm = self._gripper_position() - elapsed * velocity - self._hinge[held - 1]
        inertia = self._door_inertia + self._gripper_mass * float(arm @ arm)
        momentum = self._door_inertia * rate + self._gripper_mass * _cross(arm, velocity)
        common = momentum / inertia
        self._held, self._pin = held, _turned(arm, -angle)
        # From here on the two are one body, so that no joint can yield.
        self._world.DestroyBody(self._gripper)
        self._gripper = None
        door.massData = Box2D.b2MassData(mass=door.mass, center=(0.0, 0.0), I=inertia)
        door.angle = angle + elapsed * common
        door.angularVelocity = common

    def _time_since_touch(self, index: int) -> float:
        """Time since the two surfaces met, within this substep; s."""
        earliest, latest = 0.0, self._substep_time
        if self._gap(index, latest) < 0.0:
            return latest
        for _ in range(_HALVINGS):
            middle = 0.5 * (earliest + latest)
            if self._gap(index, middle) < 0.0:
                earliest = middle
            else:
                latest = middle
        return latest

    def _gap(self, index: int, ago: float) -> float:
        """Distance of the two surfaces ``ago`` s before the end of this substep; m."""
        door = self._doors[index - 1]
        arm = self._gripper_position() - ago * self._gripper_velocity() - self._hinge[index - 1]
        inside = _turned(arm, ago * door.angularVelocity - door.angle)
        beyond = np.abs(inside - np.array([self._middle, 0.0])) - self._inner
        return float(np.linalg.norm(np.maximum(beyond, 0.0))) - self._reach

    def _arm(self, door: Box2D.b2Body) -> np.ndarray:
        """[2] m, from the hinge to the door's middle."""
        return self._middle * np.array([np.cos(door.angle), np.sin(door.angle)])

    def _gripper_position(self) -> np.ndarray:
        if self._gripper is not None:
            return np.array(tuple(self._gripper.position))
        return self._hinge[self._held - 1] + self._pin_arm()

    def _gripper_velocity(self) -> np.ndarray:
        if self._gripper is not None:
            return np.array(tuple(self._gripper.linearVelocity))
        return self._doors[self._held - 1].angularVelocity * _left(self._pin_arm())

    def _pin_arm(self) -> np.ndarray:
        return _turned(self._pin, self._doors[self._held - 1].angle)


def _turned(vector: np.ndarray, angle: float) -> np.ndarray:
    """``vector`` ``[2]``, turned counter-clockwise by ``angle`` rad."""
    return np.cos(angle) * vector + np.sin(angle) * _left(vector)


def _left(vector: np.ndarray) -> np.ndarray:
    """``vector`` ``[2]``, turned counter-clockwise by a right angle."""
    return np.array([-vector[1], vector[0]])


def _cross(one: np.ndarray, other: np.ndarray) -> float:
    return float(one[0] * other[1] - one[1] * other[0])
