"""Bodies in pymunk (Chipmunk), which has wheels for current Pythons. Only this file imports it.

A substep has equal parts, because Chipmunk scales the impulse with which a contact begins by the
ratio of the last two steps, and takes back all of it. Forces, damping and friction with the ground
change velocities once a substep, before its parts, so that bodies move as in Box2D. State is
float64.

Bodies that are pinned together and cannot rotate are one rigid body of Chipmunk's, the *carrier* of
their shapes; so are a body that can rotate and a disc that is pinned to it and to nothing else.
These pins have no error. All others are joints.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymunk
from pymunk import Vec2d

from contactgraph.envs.planar.body import GRAVITY, PlanarBody
from contactgraph.envs.planar.pymunk_contacts import BODY, WALL, Contacts
from contactgraph.envs.planar.world import Pair

_LONGEST_PART = 1.25e-3
"""Of a substep, s: at 12 m/s two bodies come 15 mm nearer in one."""
_FINEST_PART = 0.5e-3
"""The same where two bodies that rotate freely may be joined: closing the gap of a pin, which a
part opens by half of its square times the acceleration of the pin, leaves velocities behind."""
_ITERATIONS = 20
_SLOP = 3e-4
"""Overlap that is left alone, m, so that touching bodies keep touching; Box2D: 0.16 to 0.47 mm."""
_OVERLAP_LEFT = math.exp(-400.0)
"""Share of more overlap that is left after 1 s, by velocities that last for one part."""
_JOINT_LEFT = math.exp(-400.0)
"""Share of the error of a joint that is left after 1 s, by velocities that last."""
_SKIN = 3e-4
"""Radius of the corners of boxes, m."""
_HINGE_MASS = 1e12
"""kg; the centre of mass of a hinged body is its hinge."""
_FAR, _THICK = 100.0, 5.0
"""Half the length, and half the thickness, of a wall, m: nothing gets round or through it."""
_ZERO = Vec2d(0.0, 0.0)
_State = tuple[Vec2d, float, Vec2d, float]
"""Middle, angle, velocity and angular velocity of a node."""


@dataclass(slots=True, eq=False)
class _Node:
    """A body of the world, and where it is on its carrier."""

    body: PlanarBody
    inertia: float
    """About its middle, kg m^2."""
    kept: float
    """Share of velocities that damping leaves in a substep."""
    lost: float
    """Speed that friction with the ground takes in it, m/s."""
    carrier: Any = None
    at: Vec2d = _ZERO
    """Its middle in the frame of the carrier, m."""
    shape: Any = None
    alone: bool = False
    """Whether it has a carrier for itself, which is free to move."""
    spin_kept: float = 1.0
    """Share of the carrier's angular velocity that damping leaves in a substep."""
    kick: tuple[float, float] = (0.0, 0.0)
    """Impulse of force, damping and ground in the last substep, N s."""

    @property
    def turns(self) -> bool:
        return not self.body.static and (self.body.rotates or self.body.anchor is not None)

    @property
    def upright(self) -> bool:
        return not self.body.static and not self.turns

    @property
    def middle(self) -> Vec2d:
        middle: Vec2d = self.carrier.local_to_world(self.at)
        return middle

    @property
    def velocity(self) -> Vec2d:
        velocity: Vec2d = self.carrier.velocity_at_local_point(self.at)
        return velocity

    @property
    def angle(self) -> float:
        return float(self.carrier.angle if self.turns else self.body.angle)

    @property
    def spin(self) -> float:
        return float(self.carrier.angular_velocity) if self.turns else 0.0

    @property
    def state(self) -> _State:
        return self.middle, self.angle, self.velocity, self.spin

    def inside(self, point: Vec2d) -> Vec2d:
        """A point of the world in the node's frame, which turns as the node does."""
        if self.turns:
            local: Vec2d = self.carrier.world_to_local(point)
            return local
        return point - self.middle


class PymunkEngine:
    """An `Engine`; ``time`` s is a substep's."""

    simulator = f"pymunk {pymunk.version}"

    def __init__(self, bodies: Sequence[PlanarBody], time: float, walls: np.ndarray | None) -> None:
        self._time = time
        hinges = sum(body.rotates for body in bodies) > 1
        self._parts = math.ceil(time / (_FINEST_PART if hinges else _LONGEST_PART) - 1e-9)
        self._part_time = time / self._parts
        self._space = pymunk.Space()
        self._space.iterations = _ITERATIONS
        self._space.collision_slop = _SLOP
        self._space.collision_bias = _OVERLAP_LEFT
        # A contact that is found again after some steps would begin with its old impulse.
        self._space.collision_persistence = 1
        self._contacts = Contacts(self._part_time, _SLOP)
        self._within: set[Pair] = set()
        """Pairs of one carrier that touch and are not joined."""
        self._joints: dict[Pair, tuple[Vec2d, Vec2d]] = {}
        """The point of each joint in the frames of its two nodes, m."""
        self._changed = False
        self._loaded: frozenset[Pair] = frozenset()
        """The joints that there were in the last substep."""
        self._pins: list[pymunk.PivotJoint] = []
        self._tied: list[pymunk.Body] = []
        """The carriers of joined nodes."""
        self._before: dict[pymunk.Body, tuple[Vec2d, float, float]] = {}
        """Their velocity, angular velocity and angle before the last substep."""
        self._nodes = [
            _Node(
                body,
                body.inertia - body.mass * float(body.arm @ body.arm),
                1.0 / (1.0 + time * body.damping),
                body.ground_friction * GRAVITY * time,
            )
            for body in bodies
        ]
        self._groups = [[node] for node in range(len(bodies))]
        for node, body in enumerate(bodies):
            state = _vec(body.position), body.angle, _vec(body.velocity), body.spin
            self._carry([node], {node: state})
        if walls is not None:
            for side, axis in np.ndindex(2, 2):
                self._wall(axis, side, float(walls[side, axis]))
        _on_collision(self._space, BODY, begin=self._contacts.begin, separate=self._contacts.end)
        _on_collision(self._space, WALL, begin=self._contacts.begin)
        if any(body.restitution for body in bodies):
            _on_collision(self._space, BODY, pre_solve=self._contacts.restitute)

    @property
    def touching(self) -> set[Pair]:
        """See `Engine`."""
        return (self._contacts.touching | self._within) - self._joints.keys()

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        nodes = self._nodes
        return np.array([node.middle for node in nodes]), np.array([node.angle for node in nodes])

    @property
    def twist(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        nodes = self._nodes
        return np.array([node.velocity for node in nodes]), np.array([node.spin for node in nodes])

    def advance(self, force: np.ndarray) -> None:
        """See `Engine`."""
        if self._changed:
            self._assemble()
        if self._joints:
            self._before = {
                body: (body.velocity, body.angular_velocity, body.angle) for body in self._tied
            }
            for node in self._nodes:
                node.kick = 0.0, 0.0
        for node, (x, y) in zip(self._nodes, force.tolist(), strict=True):
            if (x or y or node.lost or node.kept < 1.0) and not node.body.static:
                self._push(node, x, y)
        self._contacts.begin_substep()
        for _ in range(self._parts):
            self._space.step(self._part_time)
            if self._contacts.back:
                self._contacts.go_on()

    def join(self, pair: Pair) -> None:
        """See `Engine`."""
        if not self._loaded:
            for kind in (BODY, WALL):
                _on_collision(self._space, kind, post_solve=self._contacts.add_blow)
        one, other = (self._nodes[index] for index in pair)
        anchor = (one.carrier.position + other.carrier.position) * 0.5
        for node in (other, one):
            anchor = node.middle if node.upright else anchor
        self._joints[pair] = one.inside(anchor), other.inside(anchor)
        self._changed = True

    def part(self, pair: Pair) -> None:
        """See `Engine`."""
        del self._joints[pair]
        self._changed = True

    def joint_force(self, pair: Pair) -> np.ndarray:
        """See `Engine`.

        Chipmunk tells magnitudes alone: this is what the end with fewer joints has gained in the
        last substep, less its other impulses. It is exact for an end with one joint and no hinge.
        """
        if pair not in self._loaded:
            return np.zeros(2)
        joints = Counter(index for each in self._joints for index in each)
        end = min(reversed(pair), key=lambda i: (not self._nodes[i].upright, joints[i]))
        node = self._nodes[end]
        velocity, spin, angle = self._before[node.carrier]
        arm = (node.at - node.carrier.center_of_gravity).rotated(angle)
        before = velocity + arm.perpendicular() * spin
        impulse = (node.velocity - before) * node.body.mass - node.kick
        impulse -= self._contacts.blow.get(end, _ZERO)
        return np.array(impulse if end == pair[1] else -impulse) / self._time

    def _push(self, node: _Node, x: float, y: float) -> None:
        """Changes velocities by force, damping and friction with the ground of a substep.

        In plain numbers: `Vec2d` takes most of the time of a step else.
        """
        carrier, mass = node.carrier, node.body.mass
        vx, vy = carrier.velocity if node.alone else node.velocity
        free_x = node.kept * (vx + x * self._time / mass)
        free_y = node.kept * (vy + y * self._time / mass)
        if node.lost:
            speed = math.hypot(free_x, free_y)
            share = 1.0 - node.lost / speed if speed > node.lost else 0.0
            free_x, free_y = share * free_x, share * free_y
        node.kick = mass * (free_x - vx), mass * (free_y - vy)
        if node.spin_kept < 1.0:
            carrier.angular_velocity *= node.spin_kept
        if node.alone:
            carrier.velocity = free_x, free_y
        else:
            carrier.apply_impulse_at_world_point(node.kick, node.middle)

    def _assemble(self) -> None:
        """Makes the carriers and joints that the pins ask for."""
        touching, groups, nodes = self.touching, self._group(), self._nodes
        self._space.remove(*self._pins)
        changed = [group for group in groups if group not in self._groups]
        state = {index: nodes[index].state for group in changed for index in group}
        old = dict.fromkeys(nodes[index].carrier for index in state)
        self._space.remove(*(nodes[index].shape for index in state), *old)
        for group in changed:
            self._carry(group, state)
        self._groups, self._changed = groups, False
        self._within = {
            pair for pair in touching if nodes[pair[0]].carrier is nodes[pair[1]].carrier
        }
        self._pins = []
        for pair, points in self._joints.items():
            ends = [nodes[index] for index in pair]
            if ends[0].carrier is not ends[1].carrier:
                at = [
                    point if node.turns else node.at + point
                    for node, point in zip(ends, points, strict=True)
                ]
                pin = pymunk.PivotJoint(ends[0].carrier, ends[1].carrier, *at)
                pin.collide_bodies, pin.error_bias = False, _JOINT_LEFT
                self._pins.append(pin)
        self._space.add(*self._pins)
        self._loaded = frozenset(self._joints)
        self._tied = list({nodes[i].carrier: None for pair in self._joints for i in pair})

    def _group(self) -> list[list[int]]:
        """The nodes of each carrier: see the module."""
        joints = Counter(index for pair in self._joints for index in pair)
        groups = {index: [index] for index in range(len(self._nodes))}
        for pair in self._joints:
            upright = [index for index in pair if self._nodes[index].upright]
            turns = any(self._nodes[index].turns for index in pair)
            rides = turns and any(
                joints[index] == 1 and self._nodes[index].body.radius for index in upright
            )
            one, other = groups[pair[0]], groups[pair[1]]
            if one is not other and (rides or len(upright) == 2):
                one += other
                groups.update(dict.fromkeys(other, one))
        return [sorted(group) for index, group in groups.items() if index == group[0]]

    def _carry(self, group: list[int], state: dict[int, _State]) -> None:
        """Makes the carrier of nodes, with the momentum that they have together."""
        nodes = [self._nodes[index] for index in group]
        lead = next((index for index in group if self._nodes[index].turns), group[0])
        first, hinge = self._nodes[lead], self._nodes[lead].body.anchor
        origin, angle, *_ = state[lead]
        if not first.turns:
            angle, hinge = 0.0, None
        mass = sum(node.body.mass for node in nodes)
        centre = sum((state[i][0] * self._nodes[i].body.mass for i in group), _ZERO) / mass
        if hinge is not None:
            origin = centre = _vec(hinge)
        moment, momentum, spin = 0.0, _ZERO, 0.0
        for index, node in zip(group, nodes, strict=True):
            arm, velocity = state[index][0] - centre, state[index][2]
            own = node.inertia if node.turns else 0.0
            moment += own + node.body.mass * arm.dot(arm)
            spin += own * state[index][3] + node.body.mass * arm.cross(velocity)
            momentum += velocity * node.body.mass
        if first.body.static:
            carrier = pymunk.Body(body_type=pymunk.Body.STATIC)
        else:
            moment = moment if first.turns else math.inf
            carrier = pymunk.Body(mass if hinge is None else _HINGE_MASS, moment)
            carrier.center_of_gravity = (centre - origin).rotated(-angle)
            carrier.velocity = momentum / mass if hinge is None else _ZERO
            carrier.angular_velocity = spin / moment
        carrier.angle, carrier.position = angle, origin
        self._space.add(carrier)
        for index, node in zip(group, nodes, strict=True):
            node.carrier, node.at = carrier, (state[index][0] - origin).rotated(-angle)
            node.alone = len(group) == 1 and hinge is None
            share = node.inertia / moment if node.turns else 0.0
            node.spin_kept = 1.0 - share * (1.0 - node.kept)
            self._shape(index, state[index][1] - angle)

    def _shape(self, index: int, turn: float) -> None:
        """Makes the shape of a node, turned by ``turn`` rad in the frame of its carrier."""
        node, body = self._nodes[index], self._nodes[index].body
        if body.radius is not None:
            node.shape = pymunk.Circle(node.carrier, body.radius, node.at)
        else:
            x, y = np.asarray(body.half_size) - _SKIN
            corners = (x, y), (-x, y), (-x, -y), (x, -y)
            outline = [node.at + Vec2d(*corner).rotated(turn) for corner in corners]
            node.shape = pymunk.Poly(node.carrier, outline, radius=_SKIN)
        node.shape.friction = math.sqrt(body.friction)  # Chipmunk multiplies
        node.shape.elasticity = body.restitution
        node.shape.collision_type, node.shape.node = BODY, index
        node.shape.filter = pymunk.ShapeFilter(max(-body.group, 0))
        self._space.add(node.shape)

    def _wall(self, axis: int, side: int, face: float) -> None:
        """A thick wall without friction; its near side is at ``face`` m."""
        middle = face + (_THICK if side else -_THICK)
        start, end = [(middle, far) if axis == 0 else (far, middle) for far in (-_FAR, _FAR)]
        wall = pymunk.Segment(self._space.static_body, start, end, _THICK)
        wall.friction, wall.elasticity, wall.collision_type = 0.0, 1.0, WALL
        self._space.add(wall)


ENGINE = PymunkEngine


def _on_collision(space: pymunk.Space, other: int, **calls: Callable[..., Any]) -> None:
    """Calls at collisions of bodies with bodies or walls, in pymunk 7 and in pymunk 6."""
    if hasattr(space, "on_collision"):
        space.on_collision(BODY, other, **calls)
        return
    handler = space.add_collision_handler(BODY, other)
    for name, call in calls.items():
        setattr(handler, name, call)


def _vec(place: np.ndarray) -> Vec2d:
    return Vec2d(float(place[0]), float(place[1]))
