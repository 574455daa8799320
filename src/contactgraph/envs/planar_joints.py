"""Joints and walls of a `PlanarWorld`, given Box2D's own world and bodies."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from contactgraph.data.errors import InvalidInputError

_ARM = 1.0
"""Length of a pad's springs, m: twenty times what they stretch, so that each acts on one axis."""


@dataclass(frozen=True)
class Pad:
    """A soft bond: springs with dampers, alike along and across the line between two bodies.

    Raises `InvalidInputError` where a number is not positive.
    """

    stiffness: float = 15.0
    """N/m"""
    damping: float = 10.0
    """N s/m"""

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InvalidInputError(f"{name} must be above 0, found {getattr(self, name)}")


_FAR = 100.0
"""Half the length of a bound, m: no body gets round it."""


def walls_around(world: Any, corners: np.ndarray, scale: float) -> None:
    """Four walls without friction, number -1; ``corners`` ``[2, 2]`` m: the lower and the upper."""
    (left, low), (right, high) = corners
    points = [(left, low), (right, low), (right, high), (left, high)]
    body = world.CreateStaticBody(userData=-1)
    for start, end in zip(points, points[1:] + points[:1], strict=True):
        _edge(body, np.array([start, end]) * scale)


def bounds_of_reach(world: Any, reach: np.ndarray, distance: float, own: int, scale: float) -> None:
    """Walls, number -2, that only bodies of Box2D's group ``own`` meet.

    ``reach`` ``[2, 2]`` m: lower and upper bounds, NaN for none; ``distance`` m: of a bound behind.
    """
    body = world.CreateStaticBody(userData=-2)
    for side, axis in np.argwhere(np.isfinite(reach)):
        ends = np.array([[-_FAR, -_FAR], [_FAR, _FAR]])
        ends[:, axis] = reach[side, axis] + (distance if side else -distance)
        _edge(body, ends * scale, groupIndex=own, maskBits=0)


def _edge(body: Any, ends: np.ndarray, **which: int) -> None:
    start, end = ends.tolist()
    body.CreateEdgeFixture(vertices=[start, end], friction=0.0, restitution=0.0, **which)


def joints_between(world: Any, ends: list[Any], pad: Pad | None, scale: float) -> list[Any]:
    """The joints of two bodies that are at rest where these are now.

    Without a ``pad``: a pin at the centre of a disc that cannot rotate, else at the middle of the
    two. A pad, between two bodies that cannot rotate, is two long distance joints with frequency
    and damping ratio, along and across their line. ``scale`` is Box2D's unit of length, 1/m.
    """
    if pad is None:
        upright = [body for body in ends if body.fixedRotation and body.mass > 0.0]
        anchor = upright[0].position if upright else (ends[0].position + ends[1].position) * 0.5
        return [world.CreateRevoluteJoint(bodyA=ends[0], bodyB=ends[1], anchor=anchor)]
    mass = 1.0 / sum(1.0 / body.mass for body in ends if body.mass > 0.0)
    rate = math.sqrt(pad.stiffness / mass)
    apart = np.array(tuple(ends[1].position - ends[0].position))
    along = apart / np.linalg.norm(apart)
    joints = []
    for axis in (along, np.array([-along[1], along[0]])):
        far = np.array(tuple(ends[0].position)) + _ARM * scale * axis
        joints.append(
            world.CreateDistanceJoint(
                bodyA=ends[0],
                bodyB=ends[1],
                anchorA=ends[0].position,
                anchorB=(float(far[0]), float(far[1])),
                frequencyHz=rate / (2.0 * math.pi),
                dampingRatio=pad.damping / (2.0 * mass * rate),
            )
        )
    return joints


def total_force(joints: list[Any], step_rate: float) -> np.ndarray:
    """[2] The force of joints on their second body in the last step, in Box2D's units.

    ``step_rate`` 1/s is one over the step.
    """
    forces = [tuple(joint.GetReactionForce(step_rate)) for joint in joints]
    return np.asarray(np.reshape(forces, (-1, 2)).sum(axis=0))
