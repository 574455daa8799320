"""A gripper and a hinged bar on Box2D: hinge, impact, joint, torque."""

import numpy as np
import pytest

from contactgraph.envs.grip import HoldAtTouch
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

pytestmark = pytest.mark.usefixtures("engine")

DT = 0.05
RADIUS, LENGTH, THICKNESS = 0.04, 1.0, 0.05
GRIPPER_MASS, DOOR_MASS = 1.5, 4.0
DOOR_INERTIA = DOOR_MASS * ((LENGTH**2 + THICKNESS**2) / 12 + 0.25)
HINGE = np.array([0.3, -0.2])
FLOAT32 = 2e-5
"""Rounding error of a few hundred float32 operations on numbers around 1."""
YIELD = 1e-3
"""Relative loss of speed a second at 2 rad/s, by the joint that bends the gripper's path."""


def make_world(gripper, velocity=(0.0, 0.0), angle=0.0, rate=0.0, hold=True):
    arm = turned([LENGTH / 2, 0.0], angle)
    door = PlanarBody(
        HINGE + arm,
        DOOR_MASS,
        half_size=np.array([LENGTH, THICKNESS]) / 2,
        velocity=rate * turned(arm, np.pi / 2),
        angle=angle,
        anchor=HINGE,
    )
    disc = PlanarBody(
        np.asarray(gripper), GRIPPER_MASS, radius=RADIUS, velocity=np.asarray(velocity)
    )
    return PlanarWorld([disc, door], DT, hold=HoldAtTouch() if hold else None)


def push(world, *force):
    """Forces ``[2]`` N on gripper and door."""
    total = np.zeros_like(world.position)
    total[: len(force)] = np.reshape(force, (-1, 2))
    world.step(total)


def cross(one, other):
    return one[0] * other[1] - one[1] * other[0]


def turned(vector, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def angular_momentum(world):
    spin = DOOR_INERTIA * world.angular_velocity[1]
    return spin + GRIPPER_MASS * cross(world.position[0] - HINGE, world.velocity[0])


def thrown(place, angle=0.0, speed=1.0, heading=(0.0, -1.0)):
    """A world whose gripper coasts in the door's frame towards ``place``, from 0.3 m before it."""
    heading = np.asarray(heading) / np.linalg.norm(heading)
    start = HINGE + turned(np.asarray(place) - 0.3 * heading, angle)
    return make_world(start, speed * turned(heading, angle), angle)


def coast_to_contact(world, steps=40):
    for _ in range(steps):
        if world.holding.any():
            return
        push(world)
    raise AssertionError("the gripper must touch the door")


def test_a_bar_turns_about_its_hinge_at_a_constant_rate():
    world = make_world([3.0, 3.0], angle=0.4, rate=1.7)
    for step in range(1, 101):
        push(world)
        angle = 0.4 + 1.7 * step * DT
        arm = turned([LENGTH / 2, 0.0], angle)
        assert world.angle[1] == pytest.approx(angle, rel=1e-5)
        np.testing.assert_allclose(world.position[1], HINGE + arm, atol=5 * FLOAT32)
        np.testing.assert_allclose(
            world.velocity[1], 1.7 * turned(arm, np.pi / 2), atol=5 * FLOAT32
        )


def test_a_force_on_the_bar_is_a_torque_about_its_hinge():
    world = make_world([3.0, 3.0], angle=-0.7)
    force, angle, rate = np.array([2.0, 3.0]), -0.7, 0.0
    for _ in range(30):
        push(world, [0.0, 0.0], force)
        for _ in range(10):
            rate += DT / 10 * cross(turned([LENGTH / 2, 0.0], angle), force) / DOOR_INERTIA
            angle += DT / 10 * rate
        assert world.angular_velocity[1] == pytest.approx(rate, abs=FLOAT32)
        assert world.angle[1] == pytest.approx(angle, abs=FLOAT32)


@pytest.mark.parametrize("angle", [0.0, 2.5])
@pytest.mark.parametrize("speed", [0.5, 1.7])
def test_a_square_blow_turns_door_and_gripper_together(angle, speed):
    radius, height = 0.7, RADIUS + THICKNESS / 2
    world = thrown([radius, 0.0], angle, speed)
    coast_to_contact(world)
    push(world)
    inertia = DOOR_INERTIA + GRIPPER_MASS * (radius**2 + height**2)
    expected = -GRIPPER_MASS * radius * speed / inertia
    assert world.angular_velocity[1] == pytest.approx(expected, rel=5e-3)
    place = turned(world.position[0] - HINGE, -world.angle[1])
    np.testing.assert_allclose(place, [radius, height], atol=5e-3)


@pytest.mark.parametrize(
    ("place", "heading"),
    [
        ([0.05, 0.0], (0.2, -1.0)),  # by the hinge
        ([0.5, 0.0], (-0.6, 1.0)),  # aslant, from below
        ([1.0, 0.0], (-1.0, -0.9)),  # over a corner
        ([1.0, 0.0], (-1.0, 0.1)),  # on the end
    ],
)
def test_angular_momentum_about_the_hinge_is_conserved_wherever_the_door_is_struck(place, heading):
    world = thrown(place, angle=-1.1, speed=1.3, heading=heading)
    before = angular_momentum(world)
    coast_to_contact(world)
    push(world)
    assert angular_momentum(world) == pytest.approx(before, abs=2e-3 * GRIPPER_MASS * 1.3)
    arm = world.position[0] - HINGE
    expected = world.angular_velocity[1] * turned(arm, np.pi / 2)
    np.testing.assert_allclose(world.velocity[0], expected, atol=5e-3)
    beyond = np.abs(turned(arm, -world.angle[1]) - [LENGTH / 2, 0.0])
    gap = np.linalg.norm(np.maximum(beyond - [LENGTH / 2, THICKNESS / 2], 0.0)) - RADIUS
    assert -3e-3 < gap < 1e-3


def test_a_door_that_already_turns_is_struck_where_it_then_is():
    world = make_world(HINGE + np.array([0.5, 0.4]), rate=0.9)
    before = angular_momentum(world)
    coast_to_contact(world)
    push(world)
    assert angular_momentum(world) == pytest.approx(before, rel=2e-3)
    height = turned(world.position[0] - HINGE, -world.angle[1])[1]
    assert height == pytest.approx(RADIUS + THICKNESS / 2, abs=3e-3)


def test_without_a_force_the_pair_turns_on_and_the_pin_keeps_its_position():
    world = thrown([0.6, 0.0], speed=3.0)
    coast_to_contact(world)
    push(world)
    started = world.angular_velocity[1]
    place = turned(world.position[0] - HINGE, -world.angle[1])
    assert abs(started) > 0.8
    for step in range(1, 201):
        push(world)
        lost = YIELD * step * DT * started**2
        assert world.angular_velocity[1] == pytest.approx(started, rel=lost)
        now = turned(world.position[0] - HINGE, -world.angle[1])
        np.testing.assert_allclose(now, place, atol=2e-4)


def test_a_force_on_the_pinned_gripper_is_a_torque_about_the_hinge():
    world = thrown([0.8, 0.0], speed=0.5)
    coast_to_contact(world)
    push(world)
    force, momentum, angle = np.array([2.0, 3.0]), angular_momentum(world), world.angle[1]
    place = turned(world.position[0] - HINGE, -angle)
    inertia, substep = DOOR_INERTIA + GRIPPER_MASS * place @ place, DT / 10
    for _ in range(30):
        push(world, force)
        for _ in range(10):
            momentum += substep * cross(turned(place, angle), force)
            angle += substep * momentum / inertia
        assert angular_momentum(world) == pytest.approx(momentum, abs=0.01)
    assert abs(world.angle[1] - angle) < 0.01


def test_the_joint_with_a_door_carries_what_turns_the_door():
    """Square to the bar at r from the hinge: r F_joint = I alpha, F = (I / r + m r) alpha."""
    place = HINGE + np.array([0.6, RADIUS + THICKNESS / 2])
    world = make_world(place, hold=False)
    world.join(0, 1)
    push(world, [0.0, 0.5])
    alpha = 0.6 * 0.5 / (DOOR_INERTIA + GRIPPER_MASS * np.sum((place - HINGE) ** 2))
    assert world.angular_velocity[1] == pytest.approx(DT * alpha, rel=1e-3)
    # What remains of the force once the gripper has its own acceleration alpha x arm.
    arm = place - HINGE
    carried = np.array([0.0, 0.5]) - GRIPPER_MASS * alpha * np.array([-arm[1], arm[0]])
    assert np.linalg.norm(world.joint_force(0, 1)) == pytest.approx(
        np.linalg.norm(carried), rel=1e-2
    )


def test_a_gripper_that_is_tied_to_two_doors_locks_them():
    doors = [
        PlanarBody(
            np.array([0.5, height]),
            DOOR_MASS,
            half_size=np.array([LENGTH, THICKNESS]) / 2,
            anchor=np.array([0.0, height]),
            group=-1,
        )
        for height in (0.0, -0.3)
    ]
    gripper = PlanarBody(np.array([0.5, 0.2]), GRIPPER_MASS, radius=RADIUS)
    world = PlanarWorld([gripper, *doors], DT, hold=HoldAtTouch())
    for _ in range(60):
        push(world, [0.0, -10.0])
    assert world.holding[0].tolist() == [False, True, True]
    rest = world.position
    for _ in range(10):
        push(world, [0.0, -10.0])
    np.testing.assert_allclose(world.position, rest, atol=2e-3)
