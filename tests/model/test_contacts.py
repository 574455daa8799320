"""Contacts with a direction: each law in closed form and in simulators, and bounds on energy."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import geometry_of

from contactgraph.bodies.graph import Bodies
from contactgraph.bodies.planes import plane_geometry
from contactgraph.data.graph import pair_indices
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.dynamics.contacts import Contacts
from contactgraph.dynamics.free_bodies import FreeBodies
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

pytestmark = pytest.mark.usefixtures("double_precision")

DT, TOUCH, STIFF = 0.05, 0.1, 999.0
THETA = 0.55


@partial(jax.jit, static_argnames="on_ground")
def stepped(
    position, velocity, mass, bounce, friction, deceleration, static, averaged, pushed, on_ground
):
    """State after a step in which all pairs that meet touch; velocities, positions [N, 2].

    ``pushed`` m/s: what forces would change velocities by without contacts. ``on_ground``:
    `FreeBodies.pushed`.
    """
    count = len(mass)
    edges = jnp.asarray(pair_indices(count)).T
    found = geometry_of(position, velocity, edges, DT, TOUCH, THETA * DT * pushed, static=static)
    meets = (found.fraction_after_impact > 0.0).astype(float)
    nothing = jnp.zeros(edges.shape[1])
    contacts = Contacts(
        geometry=dataclasses.replace(found, normal=found.impact_normal),
        damper=STIFF * meets,
        spring=nothing,
        rest_length=nothing,
        touching=nothing + 1.0,
        displacing_fraction=jnp.where(averaged, 0.0, found.fraction_after_impact - THETA),
        acting=jnp.where(averaged, 1.0 - found.time_of_impact, 1.0),
        bounce=bounce * meets,
        friction=nothing + friction,
        until_impact=nothing,
        pinned=nothing,
    )
    push, slowing = (mass[:, None] * pushed)[..., None], 0.0 * mass + deceleration
    zero = jnp.zeros((count, 2, 1))
    coordinates = jnp.tile(mass[:, None], 2)
    forces = push / DT, zero, push
    bodies = FreeBodies(coordinates, velocity, 0.0 * mass, slowing, *forces, pushed=on_ground)
    moved = contacts.solve(bodies, DT, None)
    change = moved.velocity_change + DT * moved.acceleration
    after = velocity + change
    theta = jnp.where(averaged, 1.0, THETA)
    middle = velocity + theta * change
    return after, position + DT * middle + moved.impact_displacement


def step(position, velocity, mass, bounce=0.0, friction=0.0, deceleration=0.0, **options):
    static = options.get("static", np.zeros(len(mass), bool))
    arrays = (np.asarray(each, float) for each in (position, velocity, mass))
    numbers = (np.asarray(each, float) for each in (bounce, friction, deceleration))
    flags = np.asarray(static), np.asarray(options.get("averaged", False))
    pushed = np.asarray(options.get("pushed", np.zeros((len(mass), 2))), float)
    given = *arrays, *numbers, *flags, pushed
    return tuple(map(np.asarray, stepped(*given, on_ground=options.get("on_ground", False))))


START = np.array([[0.0, 0.0], [0.12, 0.03]])
STRIKES = np.array([[2.0, 0.0], [0.0, 0.0]])
MASS = np.array([1.0, 3.0])


def impact() -> tuple[float, np.ndarray]:
    """Time [s] and normal of the impact, by the quadratic equation."""
    offset, relative = START[1], STRIKES[0]
    square, along = relative @ relative, offset @ relative
    time = (along - np.sqrt(along**2 - square * (offset @ offset - TOUCH**2))) / square
    return time, (offset - time * relative) / TOUCH


@pytest.mark.parametrize("bounce", [0.0, 0.5, 0.9])
def test_a_pair_bounces_by_its_coefficient_at_the_time_of_impact(bounce: float) -> None:
    time, normal = impact()
    impulse = 0.75 * (1.0 + bounce) * (STRIKES[0] @ normal)
    expected = STRIKES + np.array([[-impulse], [impulse / 3.0]]) * normal
    velocity, position = step(START, STRIKES, MASS, bounce)
    np.testing.assert_allclose(velocity, expected, atol=3e-3)
    where = START + time * STRIKES + (DT - time) * expected
    np.testing.assert_allclose(position, where, atol=1e-4)
    np.testing.assert_allclose(MASS @ velocity, MASS @ STRIKES, atol=1e-9)


@pytest.mark.parametrize("bounce", [0.0, 0.9])
@pytest.mark.parametrize("gap", [0.001, 0.03, 0.08])
def test_a_force_counts_until_the_impact_and_then_moves_one_body(bounce: float, gap: float) -> None:
    """10 N drive a cue of 1 kg at 1.5 m/s into a ball of 3 kg: head on, early or late in a step."""
    start, pushed = np.array([[0.0, 0.0], [TOUCH + gap, 0.0]]), np.array([[0.5, 0.0], [0.0, 0.0]])
    velocity, _ = step(start, [[1.5, 0.0], [0.0, 0.0]], MASS, bounce, pushed=pushed)
    by_force = THETA * 0.5  # gap = DT (1.5 t + by_force t^2)
    time = (np.sqrt(1.5**2 + 4.0 * by_force * gap / DT) - 1.5) / (2.0 * by_force)
    struck = 0.25 * (1.0 + bounce) * (1.5 + time * 0.5)
    together = 0.25 * 2.0  # the cue pushes on, if it does not bounce
    expected = struck if bounce else together
    np.testing.assert_allclose(velocity[1], [expected, 0.0], atol=4e-3)
    np.testing.assert_allclose(MASS @ velocity, [2.0, 0.0], atol=1e-9)


def test_velocities_that_are_means_show_an_impact_in_its_part_of_the_step() -> None:
    time, normal = impact()
    impulse = 0.75 * (STRIKES[0] @ normal)
    after = STRIKES + np.array([[-impulse], [impulse / 3.0]]) * normal
    velocity, position = step(START, STRIKES, MASS, averaged=True)
    where = START + time * STRIKES + (DT - time) * after
    np.testing.assert_allclose(velocity, (where - START) / DT, atol=3e-3)
    np.testing.assert_allclose(position, START + DT * velocity, atol=1e-12)


@pytest.mark.parametrize(("coefficient", "sticks"), [(0.05, False), (0.1, False), (5.0, True)])
def test_friction_is_at_most_its_coefficient_times_the_normal_impulse(coefficient, sticks) -> None:
    _, normal = impact()
    across = np.array([-normal[1], normal[0]])
    velocity, _ = step(START, STRIKES, MASS, 0.9, coefficient)
    along = 3.0 * velocity[1] @ normal
    sideways = 3.0 * velocity[1] @ across
    stick = 0.75 * (STRIKES[0] @ across)
    bound = np.sign(stick) * coefficient * along
    np.testing.assert_allclose(sideways, stick if sticks else bound, rtol=6e-3)
    assert abs(bound) > abs(stick) or not sticks


def test_a_disc_slides_to_rest_and_stays() -> None:
    speed, velocity, position = 0.5, np.array([[0.3, 0.4]]), np.zeros((1, 2))
    speeds = []
    for _ in range(30):
        velocity, position = step(position, velocity, [2.0], deceleration=0.5)
        speeds.append(np.linalg.norm(velocity))
    expected = np.maximum(speed - 0.5 * DT * np.arange(1, 31), 0.0)
    np.testing.assert_allclose(speeds, expected, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(position), 0.5 * speed**2 / 0.5, rtol=0.02)


MOVES, PUSH, SLOWED = 0.4, 0.3, np.array([0.0, 1.0])
"""Of a hand that pushes a block along: m/s, m/s a step, and m/s^2 by the ground."""


@pytest.mark.parametrize("angle", [0.0, 0.6, np.pi / 4])
@pytest.mark.parametrize("across", [0.0, 0.3])
def test_what_the_ground_takes_from_a_block_the_hand_gives(angle: float, across: float) -> None:
    """Along the normal, whatever its direction, and with it friction where the hand slides."""
    along, aside = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    velocity = MOVES * np.array([along, along]) + np.array([across * aside, 0.0 * aside])
    pushed = np.array([PUSH * along, 0.0 * along])
    given = {"friction": 0.2, "deceleration": SLOWED, "pushed": pushed, "on_ground": True}
    after, _ = step(np.array([0.0 * along, 0.99 * TOUCH * along]), velocity, MASS, **given)
    faster = (MASS[0] * PUSH - MASS[1] * SLOWED[1] * DT) / MASS.sum()
    np.testing.assert_allclose(after @ along, MOVES + faster, atol=5e-3)
    normal_impulse = MASS[1] * (faster + SLOWED[1] * DT)
    rubbed = min(0.2 * normal_impulse, across * MASS.prod() / MASS.sum())
    np.testing.assert_allclose(
        (velocity - after)[0] @ aside, rubbed / MASS[0], rtol=0.05, atol=1e-4
    )


def test_the_ground_slows_a_block_from_the_moment_on_in_which_it_is_struck() -> None:
    start = np.array([[0.0, 0.0], [START[1, 0], 0.0]])
    time = (start[1, 0] - TOUCH) / STRIKES[0, 0]
    velocity, _ = step(start, STRIKES, MASS, deceleration=5.0 * SLOWED, on_ground=True)
    taken = MASS[1] * 5.0 * (DT - time)
    expected = (MASS[0] * STRIKES[0, 0] - taken) / MASS.sum()
    np.testing.assert_allclose(velocity[:, 0], expected, atol=5e-3)


def test_static_bodies_stay_where_they_are_exactly() -> None:
    velocity, position = step(START, STRIKES, MASS, 0.9, static=[False, True])
    np.testing.assert_array_equal(velocity[1], 0.0)
    np.testing.assert_array_equal(position[1], START[1])
    _, normal = impact()
    expected = STRIKES[0] - 1.9 * (STRIKES[0] @ normal) * normal
    np.testing.assert_allclose(velocity[0], expected, atol=4e-3)


def test_kinetic_energy_never_grows() -> None:
    rng, ratios = np.random.default_rng(0), []
    for _ in range(300):
        position, velocity = 0.12 * rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
        mass = np.exp(2.0 * rng.normal(size=5))
        bounce, friction = rng.uniform(0.0, 0.999, 10), rng.uniform(0.0, 2.0)
        after, _ = step(position, velocity, mass, bounce, friction, rng.uniform())
        np.testing.assert_array_less(0.0, mass)
        energy = [float(mass @ np.sum(each**2, axis=1)) for each in (velocity, after)]
        ratios.append(energy[1] / energy[0])
    assert max(ratios) <= 1.0 + 1e-9 and min(ratios) < 0.5


def test_momentum_is_kept_without_the_ground() -> None:
    rng = np.random.default_rng(1)
    position, velocity = 0.1 * rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
    mass = np.exp(rng.normal(size=5))
    after, _ = step(position, velocity, mass, 0.7, 0.4)
    assert np.abs(after - velocity).max() > 0.1
    np.testing.assert_allclose(mass @ after, mass @ velocity, atol=1e-9)


@pytest.mark.parametrize(("bounce", "friction"), [(0.0, 0.0), (0.9, 0.0), (0.5, 0.2)])
@pytest.mark.usefixtures("engine")
def test_a_collision_is_that_of_a_simulator(bounce: float, friction: float) -> None:
    position = np.array([[0.0, 0.0], [0.15, 0.04]])
    bodies = [
        PlanarBody(
            position[index],
            MASS[index],
            radius=0.5 * TOUCH,
            velocity=STRIKES[index],
            restitution=bounce,
            friction=friction,
        )
        for index in range(2)
    ]
    world, velocity = PlanarWorld(bodies, DT), STRIKES
    for _ in range(2):
        velocity, position = step(position, velocity, MASS, bounce, friction)
        world.step(np.zeros((2, 2)))
    # Box2D finds the overlap up to a substep of 5 ms late, which turns the normal; pymunk does not.
    np.testing.assert_allclose(velocity, world.velocity, atol=0.12)
    assert np.linalg.norm(velocity[1]) > 0.3


def over_a_plane(position, velocity, bounce=0.0, lift=0.0) -> tuple[Contacts, FreeBodies]:
    """A ball of 1 kg that falls; a hand that adds ``lift`` [m/s] is not known to the geometry."""
    nodes = Nodes(
        actuated=np.zeros(1, bool),
        mask=np.ones(1, bool),
        candidate=np.zeros(0, bool),
        planes=np.array([[0.0, 1.0, 0.2], [0.0, 0.0, 0.0]]),
    )
    nodes = jax.tree.map(jnp.asarray, nodes)
    weight = jnp.array([[0.0, -9.81 * DT]])
    motion = DT * (velocity + weight)
    bodies = Bodies(position, velocity, nodes, jnp.ones((1, 1)), jnp.zeros(1))
    found = plane_geometry(bodies, motion, jnp.array([0.05]))
    meets = jnp.any(found.contact_jacobian[0] != 0.0, axis=(1, 2)).astype(float)
    nothing = jnp.zeros(2)
    contacts = Contacts(
        found,
        damper=STIFF * meets,
        spring=nothing,
        rest_length=nothing,
        touching=nothing + 1.0,
        displacing_fraction=found.fraction_after_impact - THETA,
        acting=nothing + 1.0,
        bounce=bounce * meets,
        friction=nothing,
        until_impact=nothing,
        pinned=nothing,
    )
    forces = weight[..., None] / DT, jnp.zeros((1, 2, 1)), (weight + lift * UP)[..., None]
    alone = jnp.ones((1, 2)), velocity, jnp.zeros(1), jnp.zeros(1)
    return contacts, FreeBodies(*alone, *forces)


UP = jnp.array([[0.0, 1.0]])


@pytest.mark.parametrize("lift", [0.0, 0.4, 0.6, 2.0])
def test_a_plane_bears_a_ball_and_lets_go_of_one_that_is_lifted(lift: float) -> None:
    contacts, bodies = over_a_plane(jnp.array([[0.3, 0.25]]), -0.02 * UP, lift=lift)
    assert contacts.damper[0] > 0.0
    borne = lift < 9.81 * DT + 0.02
    assert (contacts.pushing(bodies, DT, None).damper[0] > 0.0) == borne
    assert contacts.pushing(bodies, DT, None, jnp.zeros(2, bool)).damper[0] > 0.0


def test_a_ball_bounces_off_a_plane_and_rests_on_it() -> None:
    @jax.jit
    def fall(position, velocity, bounce):
        contacts, bodies = over_a_plane(position, velocity, bounce)
        moved = contacts.solve(bodies, DT, None)
        change = moved.velocity_change + DT * moved.acceleration
        after = velocity + change
        return position + DT * (velocity + THETA * change) + moved.impact_displacement, after

    # It falls at 2 m/s and is 1 cm above touch: it turns, and the other plane has no normal.
    start = jnp.array([[0.3, 0.26]]), jnp.array([[0.5, -2.0]])
    position, velocity = fall(*start, 0.8)
    pulled = 9.81 * DT
    time = 0.01 / (DT * (2.0 + pulled))
    upward = 0.8 * (2.0 + time * pulled) - (1.0 - time) * pulled
    np.testing.assert_allclose(velocity[0], [0.5, upward], atol=2e-2)
    assert position[0, 1] > 0.3
    position, velocity = jnp.array([[0.3, 0.25]]), jnp.zeros((1, 2))
    for _ in range(20):
        position, velocity = fall(position, velocity, 0.8)
    np.testing.assert_allclose(position[0], [0.3, 0.25], atol=1e-3)
    np.testing.assert_allclose(velocity[0], 0.0, atol=1e-3)
