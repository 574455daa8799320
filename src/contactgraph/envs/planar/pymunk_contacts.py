"""Contacts of bodies in Chipmunk, given its own objects.

Chipmunk has no continuous collision detection: it finds a touch once two bodies overlap, up to a
step late. Both are then taken back to the moment of touch, where the impact is solved, and move for
the time since then at their new velocities.
"""

import math
from typing import Any

from contactgraph.envs.planar.world import Pair

BODY, WALL = 1, 2
"""Types of collisions; a body's shape has the attribute ``node``."""


class Contacts:
    """Callbacks of a space with steps of ``time`` s that leaves an overlap of ``slop`` m alone."""

    def __init__(self, time: float, slop: float) -> None:
        self._time, self._slop = time, slop
        self._now: set[Pair] = set()
        self._begun: set[Pair] = set()
        self.back: dict[Any, float] = {}
        """The time for which a body has been taken back, s."""
        self.blow: dict[int, Any] = {}
        """Impulses on nodes in the last substep, N s, where `add_blow` is called."""

    @property
    def touching(self) -> set[Pair]:
        """The pairs that touch, or have begun to in this substep."""
        return self._now | self._begun

    def begin_substep(self) -> None:
        """Forgets what has begun in the last one."""
        self._begun.clear()
        self.blow.clear()

    def go_on(self) -> None:
        """After a step: moves bodies that were taken back to its end."""
        for body, time in self.back.items():
            body.position += body.velocity * time
            body.angle += body.angular_velocity * time
        self.back.clear()

    def begin(self, arbiter: Any, space: Any, data: Any) -> bool:
        """Notes a pair, and takes two bodies that begin to touch back to that moment."""
        shapes, contact = arbiter.shapes, arbiter.contact_point_set
        if all(shape.collision_type == BODY for shape in shapes):
            self._now.add(_pair(shapes))
            self._begun.add(_pair(shapes))
        discs = all(hasattr(shape, "offset") for shape in shapes)
        ends = [contact.points[0].point_a, contact.points[0].point_b]
        if discs:
            ends = [shape.body.local_to_world(shape.offset) for shape in shapes]
        bodies = [shape.body for shape in shapes]
        speeds = [body.velocity_at_world_point(end) for body, end in zip(bodies, ends, strict=True)]
        speed = speeds[1] - speeds[0]
        if discs:
            one, other = (
                end + velocity * self.back.get(body, 0.0)
                for end, velocity, body in zip(ends, speeds, bodies, strict=True)
            )
            reach = shapes[0].radius + shapes[1].radius - self._slop
            ago = _since_touch(other - one, speed, reach)
        else:
            closing = -speed.dot(contact.normal)
            deep = -contact.points[0].distance - self._slop
            ago = deep / closing if deep > 0.0 and closing > 0.0 else 0.0
        ago = min(ago, self._time)
        for body in bodies:
            further = ago - self.back.get(body, 0.0)
            if further > 0.0 and body.mass < math.inf:  # not a static one
                body.position -= body.velocity * further
                body.angle -= body.angular_velocity * further
                self.back[body] = ago
        if discs:
            one, other = (shape.body.local_to_world(shape.offset) for shape in shapes)
            contact.normal = (other - one).normalized()
            contact.points[0].point_a = one + contact.normal * shapes[0].radius
            contact.points[0].point_b = other - contact.normal * shapes[1].radius
            arbiter.contact_point_set = contact
        return True

    def end(self, arbiter: Any, space: Any, data: Any) -> bool:
        """Notes that a pair no longer touches."""
        self._now.discard(_pair(arbiter.shapes))
        return True

    def restitute(self, arbiter: Any, space: Any, data: Any) -> bool:
        """Takes the larger restitution; Chipmunk multiplies them."""
        arbiter.restitution = max(shape.elasticity for shape in arbiter.shapes)
        return True

    def add_blow(self, arbiter: Any, space: Any, data: Any) -> None:
        """Adds up the impulses on each node."""
        for shape, sign in zip(arbiter.shapes, (1.0, -1.0), strict=True):
            if shape.collision_type == BODY:
                blow = arbiter.total_impulse * sign
                self.blow[shape.node] = self.blow.get(shape.node, 0.0 * blow) + blow


def _pair(shapes: Any) -> Pair:
    one, other = (shape.node for shape in shapes)
    return min(one, other), max(one, other)


def _since_touch(apart: Any, speed: Any, reach: float) -> float:
    """The time since two discs ``apart`` m had the distance ``reach`` m, s; 0 if it is greater."""
    inside, square = reach**2 - apart.dot(apart), speed.dot(speed)
    if inside <= 0.0 or square == 0.0:
        return 0.0
    along = apart.dot(speed)
    return float(along + math.sqrt(along**2 + square * inside)) / square
