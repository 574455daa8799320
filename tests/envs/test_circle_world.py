import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs.circle_world import CircleWorld

RADIUS = 0.04
DT = 0.05
FLOAT32 = 2e-5
"""Rounding error of a few hundred float32 operations on numbers around 1."""


def make_world(position, substeps=10, mass=None):
    count = len(position)
    mass = np.ones(count) if mass is None else np.asarray(mass, dtype=float)
    return CircleWorld(np.asarray(position), mass, np.full(count, RADIUS), DT, substeps)


def push(world, index, force):
    total = np.zeros_like(world.position)
    total[index] = force
    world.step(total)


def dense_run(steps=200, substeps=10, seed=0):
    """Body 0 is driven from one to the next of nine others and sweeps most of them up."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid([-0.2, 0.0, 0.2], [-0.2, 0.0, 0.2]), axis=-1).reshape(-1, 2)
    position = np.concatenate([[[-0.6, 0.02]], grid + rng.uniform(-0.03, 0.03, grid.shape)])
    mass = rng.uniform(0.5, 2.0, len(position))
    world = make_world(position, substeps, mass)
    states, forces = [(world.position, world.velocity, world.contact)], []
    for _ in range(steps):
        way = world.position - world.position[0]
        way[groups(world.contact)[0]] = np.inf
        nearest = way[np.argmin(np.linalg.norm(way, axis=-1))]
        aim = nearest if np.isfinite(nearest).all() else np.zeros(2)
        force = 20.0 * aim - 3.0 * world.velocity[0] + rng.normal(0.0, 1.0, 2)
        push(world, 0, force)
        states.append((world.position, world.velocity, world.contact))
        forces.append(force)
    position, velocity, contact = (np.stack(each) for each in zip(*states, strict=True))
    return mass, position, velocity, contact, np.stack(forces)


def groups(contact):
    reach = contact | np.eye(len(contact), dtype=bool)
    for _ in range(len(contact)):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


@pytest.mark.parametrize("substeps", [1, 5, 10])
def test_constant_force_is_the_theta_method(substeps):
    world = make_world([[0.0, 0.0]], substeps, mass=[2.0])
    force = np.array([3.0, -1.0])
    theta = (substeps + 1) / (2 * substeps)
    position, velocity = np.zeros(2), np.zeros(2)
    for _ in range(20):
        push(world, 0, force)
        position = position + DT * velocity + theta * DT**2 * force / 2.0
        velocity = velocity + DT * force / 2.0
        np.testing.assert_allclose(world.velocity[0], velocity, atol=FLOAT32)
        np.testing.assert_allclose(world.position[0], position, atol=FLOAT32)


def test_slow_bodies_are_not_put_to_sleep():
    world = make_world([[0.0, 0.0]])
    push(world, 0, [0.1, 0.0])
    speed = world.velocity[0, 0]
    for _ in range(40):
        push(world, 0, [0.0, 0.0])
        assert world.velocity[0, 0] == speed == pytest.approx(0.005)


def test_a_force_does_not_outlast_its_step():
    world = make_world([[0.0, 0.0]])
    push(world, 0, [4.0, 0.0])
    speed = world.velocity[0, 0]
    push(world, 0, [0.0, 0.0])
    assert world.velocity[0, 0] == speed


@pytest.mark.parametrize("substeps", [1, 5, 10, 20])
@pytest.mark.parametrize("gap", [0.012, 0.033, 0.0499, 0.061])
def test_an_impact_is_resolved_at_the_moment_of_touch(substeps, gap):
    world = make_world([[0.0, 0.0], [0.08 + gap + 1.0, 0.0]], substeps, mass=[1.0, 3.0])
    push(world, 0, [20.0, 0.0])  # 1 m/s, then coasting
    start, speed = world.position[0, 0], 1.0
    for step in range(1, 40):
        push(world, 0, [0.0, 0.0])
        touch = (1.0 + gap - start) / speed
        late = max(step * DT - touch, 0.0)
        first = start + speed * (step * DT - late) + 0.25 * speed * late
        np.testing.assert_allclose(world.position[0], [first, 0.0], atol=FLOAT32)
        assert world.contact[0, 1] == (late > 0.0)
        if late > 0.0:
            np.testing.assert_allclose(world.velocity, [[0.25, 0.0]] * 2, atol=FLOAT32)
            assert abs(world.position[1, 0] - world.position[0, 0] - 2 * RADIUS) < FLOAT32
    assert world.contact[0, 1]


def test_momentum_is_conserved_through_every_impact_and_by_every_group():
    mass, _, velocity, contact, force = dense_run()
    assert groups(contact[-1])[0].sum() >= 5, "the run must sweep up a group"
    momentum = np.einsum("n,tnd->td", mass, velocity)
    np.testing.assert_allclose(np.diff(momentum, axis=0), DT * force, atol=FLOAT32)


def test_the_centre_of_mass_moves_as_if_nothing_had_touched():
    mass, position, _, _, force = dense_run()
    theta = 11 / 20
    centre = np.einsum("n,tnd->td", mass, position) / mass.sum()
    expected, velocity = [centre[0]], np.zeros(2)
    for each in force:
        acceleration = each / mass.sum()
        expected.append(expected[-1] + DT * velocity + theta * DT**2 * acceleration)
        velocity = velocity + DT * acceleration
    np.testing.assert_allclose(centre, expected, atol=FLOAT32)


def test_a_group_has_one_velocity_at_once_and_stays_rigid():
    _, position, velocity, contact, _ = dense_run()
    for step in range(len(position)):
        together = groups(contact[step])
        difference = np.abs(velocity[step][:, None] - velocity[step]).max(axis=-1)
        assert difference[together].max() < FLOAT32
        distance = np.linalg.norm(position[step][:, None] - position[step], axis=-1)
        assert np.all(np.abs(distance[contact[step]] - 2 * RADIUS) < FLOAT32)
        assert distance[~np.eye(len(distance), dtype=bool)].min() > 2 * RADIUS - FLOAT32


def test_contacts_are_symmetric_never_end_and_are_of_touching_pairs_only():
    _, _, _, contact, _ = dense_run()
    assert np.array_equal(contact, contact.swapaxes(1, 2))
    assert not np.any(np.diagonal(contact, axis1=1, axis2=2))
    assert not np.any(contact[:-1] & ~contact[1:])
    together = groups(contact[-1])
    assert together.sum() > contact[-1].sum() + len(together), "groups are joined transitively"


def test_two_bodies_struck_at_once_go_on_together():
    touching = 0.07
    world = make_world([[0.0, 0.0], [0.3, touching], [0.3, -touching]])
    push(world, 0, [20.0, 0.0])
    while not world.contact.any():
        push(world, 0, [0.0, 0.0])
    assert world.contact[0, 1] and world.contact[0, 2] and not world.contact[1, 2]
    np.testing.assert_allclose(world.velocity, [[1.0 / 3.0, 0.0]] * 3, atol=FLOAT32)


@pytest.mark.parametrize(("offset", "hit"), [(0.0795, True), (0.0805, False)])
def test_a_passing_body_is_not_grasped(offset, hit):
    world = make_world([[0.0, 0.0], [0.3, offset]])
    push(world, 0, [10.0, 0.0])
    for _ in range(30):
        push(world, 0, [0.0, 0.0])
    assert world.contact[0, 1] == hit


def test_episodes_repeat_bit_for_bit():
    for one, other in zip(dense_run(steps=80), dense_run(steps=80), strict=True):
        assert np.array_equal(one, other)


def test_substeps_out_of_range():
    with pytest.raises(InvalidInputError, match="substeps must be at least 1, found 0"):
        make_world([[0.0, 0.0]], substeps=0)
