import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs.door_world import DoorWorld

DT = 0.05
RADIUS, LENGTH, THICKNESS = 0.04, 1.0, 0.05
GRIPPER_MASS, DOOR_MASS = 1.5, 4.0
DOOR_INERTIA = DOOR_MASS * ((LENGTH**2 + THICKNESS**2) / 12 + 0.25)
HINGE = np.array([0.3, -0.2])
FLOAT32 = 2e-5
"""Rounding error of a few hundred float32 operations on numbers around 1."""


def make_world(gripper, angle=0.0, hinge=HINGE, substeps=10):
    return DoorWorld(
        np.asarray(gripper),
        np.atleast_2d(hinge),
        np.atleast_1d(angle),
        gripper_mass=GRIPPER_MASS,
        gripper_radius=RADIUS,
        door_mass=DOOR_MASS,
        length=LENGTH,
        thickness=THICKNESS,
        dt=DT,
        substeps=substeps,
    )


def push(world, *force):
    """Forces ``[2]`` N on the gripper, the first door, ..."""
    total = np.zeros_like(world.position)
    total[: len(force)] = np.reshape(force, (-1, 2))
    world.step(total)


def cross(one, other):
    return one[0] * other[1] - one[1] * other[0]


def rate(world, door=1):
    """Angular velocity of a door, rad/s, from the motion of its middle."""
    arm = world.position[door] - HINGE
    return cross(arm, world.velocity[door]) / (arm @ arm)


def angular_momentum(world):
    position, velocity = world.position, world.velocity
    spin = DOOR_INERTIA * rate(world)
    return spin + GRIPPER_MASS * cross(position[0] - HINGE, velocity[0])


def turned(vector, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vector


def thrown(place, angle=0.0, speed=1.0, substeps=10, heading=(0.0, -1.0)):
    """A world whose gripper coasts in the door's frame towards ``place``, from 0.3 m before it."""
    heading = np.asarray(heading) / np.linalg.norm(heading)
    start = HINGE + turned(np.asarray(place) - 0.3 * heading, angle)
    world = make_world(start, angle, substeps=substeps)
    push(world, GRIPPER_MASS * speed / DT * turned(heading, angle))
    return world


def coast_to_contact(world, steps=40):
    for _ in range(steps):
        if world.contact.any():
            return
        push(world)
    raise AssertionError("the gripper must touch the door")


@pytest.mark.parametrize("substeps", [1, 10, 20])
@pytest.mark.parametrize("angle", [0.0, 2.5])
@pytest.mark.parametrize("speed", [0.5, 0.83, 1.7])
def test_an_impact_is_resolved_at_the_moment_of_touch(substeps, angle, speed):
    radius = 0.7
    world = thrown([radius, 0.0], angle, speed, substeps)
    gap = turned(world.position[0] - HINGE, -angle)[1] - RADIUS - THICKNESS / 2
    height = RADIUS + THICKNESS / 2
    inertia = DOOR_INERTIA + GRIPPER_MASS * (radius**2 + height**2)
    expected = -GRIPPER_MASS * radius * speed / inertia
    for step in range(1, 20):
        push(world)
        late = step * DT - gap / speed
        assert world.contact[0, 1] == (late > 0.0)
        if late > 0.0:
            assert abs(rate(world) - expected) < FLOAT32
            now = angle + expected * late
            np.testing.assert_allclose(
                world.position[1], HINGE + turned([LENGTH / 2, 0.0], now), atol=FLOAT32
            )
            np.testing.assert_allclose(
                world.position[0], HINGE + turned([radius, height], now), atol=FLOAT32
            )
    assert world.contact[0, 1]


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
    assert abs(angular_momentum(world) - before) < FLOAT32
    np.testing.assert_allclose(
        world.velocity[0],
        rate(world) * turned(world.position[0] - HINGE, np.pi / 2),
        atol=FLOAT32,
    )
    distance = surface_distance(turned(world.position[0] - HINGE, -bar_angle(world)))
    rounding = 0.01 * (np.sqrt(2.0) - 1.0)
    assert -rounding - FLOAT32 < distance < FLOAT32


def surface_distance(place):
    beyond = np.abs(place - [LENGTH / 2, 0.0]) - [LENGTH / 2, THICKNESS / 2]
    return np.linalg.norm(np.maximum(beyond, 0.0)) - RADIUS


def bar_angle(world):
    return np.arctan2(*(world.position[1] - HINGE)[::-1])


def test_a_door_that_already_turns_is_struck_where_it_then_is():
    world = make_world(HINGE + np.array([0.5, 0.4]))
    push(world, [0.0, 0.0], [0.0, 60.0])
    before = angular_momentum(world)
    assert rate(world) == pytest.approx(60.0 * 0.5 * DT / DOOR_INERTIA, rel=1e-3)
    coast_to_contact(world)
    assert angular_momentum(world) == pytest.approx(before, abs=FLOAT32)
    height = turned(world.position[0] - HINGE, -bar_angle(world))[1]
    assert height == pytest.approx(RADIUS + THICKNESS / 2, abs=FLOAT32)


def test_without_a_force_the_pair_keeps_its_angular_speed_and_the_pin_its_position():
    world = thrown([0.6, 0.0], speed=3.0)
    coast_to_contact(world)
    started = rate(world)
    place = turned(world.position[0] - HINGE, -bar_angle(world))
    assert abs(started) > 0.8
    for _ in range(200):
        push(world)
        assert rate(world) == pytest.approx(started, rel=1e-6)
        assert np.linalg.norm(world.position[1] - HINGE) == pytest.approx(0.5, abs=1e-7)
        now = turned(world.position[0] - HINGE, -bar_angle(world))
        np.testing.assert_allclose(now, place, atol=1e-6)


def test_a_slow_door_is_not_put_to_sleep():
    world = make_world([2.0, 2.0])
    push(world, [0.0, 0.0], [0.0, 0.1])
    speed = rate(world)
    for _ in range(40):
        push(world)
        assert rate(world) == pytest.approx(speed, rel=1e-5) and speed > 1e-3


def test_a_force_on_the_pinned_gripper_is_a_torque_about_the_hinge():
    world = thrown([0.8, 0.0], speed=0.5)
    coast_to_contact(world)
    force, momentum, angle = np.array([2.0, 3.0]), angular_momentum(world), bar_angle(world)
    place = turned(world.position[0] - HINGE, -angle)
    inertia, substep = DOOR_INERTIA + GRIPPER_MASS * place @ place, DT / 10
    for _ in range(30):
        push(world, force)
        for _ in range(10):
            momentum += substep * cross(turned(place, angle), force)
            angle += substep * momentum / inertia
        assert angular_momentum(world) == pytest.approx(momentum, abs=5 * FLOAT32)
    assert abs(bar_angle(world) - angle) < 5 * FLOAT32


def test_the_gripper_grasps_one_door_and_passes_others():
    hinge = np.array([HINGE, HINGE + np.array([0.0, -0.3])])
    world = make_world(HINGE + np.array([0.5, 0.2]), np.zeros(2), hinge)
    lowest = np.inf
    for _ in range(40):
        push(world, [0.0, -10.0])
        lowest = min(lowest, world.position[0, 1])
    assert world.contact[0].tolist() == [False, True, False]
    assert lowest < hinge[1, 1] - 0.1, "the run must lead past the second door"
    np.testing.assert_array_equal(world.position[2], hinge[1] + [0.5, 0.0])
    assert not world.velocity[2].any()


def test_doors_pass_one_another():
    hinge = np.array([HINGE, HINGE + np.array([0.3, 0.3])])
    world = make_world([3.0, 3.0], np.zeros(2), hinge)
    for _ in range(30):
        push(world, [0.0, 0.0], [0.0, 10.0])
    assert bar_angle(world) > 1.2 and not world.contact.any()
    assert not world.velocity[2].any()


def test_a_free_gripper_moves_as_a_free_body():
    world = make_world([2.0, 2.0])
    position, velocity, force = np.array([2.0, 2.0]), np.zeros(2), np.array([3.0, -1.0])
    for _ in range(20):
        push(world, force)
        position = position + DT * velocity + 0.55 * DT**2 * force / GRIPPER_MASS
        velocity = velocity + DT * force / GRIPPER_MASS
        np.testing.assert_allclose(world.velocity[0], velocity, atol=FLOAT32)
        np.testing.assert_allclose(world.position[0], position, atol=FLOAT32)


def test_episodes_repeat_bit_for_bit():
    def run():
        world = thrown([0.4, 0.0], angle=0.3, speed=1.1)
        states = []
        for step in range(40):
            push(world, [np.sin(step), np.cos(step)])
            states.append(np.stack([world.position, world.velocity]))
        assert world.contact.any()
        return np.stack(states)

    assert np.array_equal(run(), run())


def test_substeps_out_of_range():
    with pytest.raises(InvalidInputError, match="substeps must be at least 1, found 0"):
        make_world([1.0, 1.0], substeps=0)
