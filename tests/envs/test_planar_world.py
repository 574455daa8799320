import copy

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs.grip import HoldAtTouch
from contactgraph.envs.planar import world as engines
from contactgraph.envs.planar.body import GRAVITY, PlanarBody
from contactgraph.envs.planar.world import PlanarWorld

pytestmark = pytest.mark.usefixtures("engine")

RADIUS = 0.04
DT = 0.05
FLOAT32 = 2e-5
"""Rounding error of a few hundred float32 operations on numbers around 1."""
SLOP = 5e-4
"""The overlap at which Box2D sees a touch, m."""


def disc(position, velocity=(0.0, 0.0), mass=1.0, **more):
    return PlanarBody(
        np.asarray(position, float), mass, radius=RADIUS, velocity=np.asarray(velocity), **more
    )


def push(world, *force):
    """Forces ``[2]`` N on the first bodies; none on the others."""
    total = np.zeros_like(world.position)
    total[: len(force)] = np.reshape(force, (-1, 2))
    world.step(total)


def coast(world, steps):
    for _ in range(steps):
        push(world)


def energy(mass, velocity):
    return 0.5 * np.asarray(mass) @ np.sum(velocity**2, axis=-1)


@pytest.mark.parametrize("substeps", [2, 5, 10])
def test_constant_force_is_the_theta_method(substeps):
    world = PlanarWorld([disc([0.0, 0.0], mass=2.0)], DT, substeps)
    force = np.array([3.0, -1.0])
    theta = (substeps + 1) / (2 * substeps)
    position, velocity = np.zeros(2), np.zeros(2)
    for _ in range(20):
        push(world, force)
        position = position + DT * velocity + theta * DT**2 * force / 2.0
        velocity = velocity + DT * force / 2.0
        np.testing.assert_allclose(world.velocity[0], velocity, atol=FLOAT32)
        np.testing.assert_allclose(world.position[0], position, atol=FLOAT32)


def test_slow_bodies_are_not_put_to_sleep_and_a_force_does_not_outlast_its_step():
    world = PlanarWorld([disc([0.0, 0.0])], DT)
    push(world, [0.1, 0.0])
    speed = world.velocity[0, 0]
    for _ in range(40):
        push(world)
        assert world.velocity[0, 0] == speed == pytest.approx(0.005)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    ("mass", "speed", "substeps", "gap"),
    [
        *((3.0, 1.0, substeps, gap) for substeps in (1, 10) for gap in (0.012, 0.033, 0.061)),
        *((1.0, speed, 10, 0.03 * speed + 0.0007) for speed in (0.5, 2.0, 6.0, 12.0)),
    ],
)
def test_an_impact_is_where_and_as_the_closed_form_says(
    engine, mass, speed, substeps, gap, restitution
):
    """Head-on, 1 kg on m at rest: v1 = (1 - m e) v / (1 + m), v2 = (1 + e) v / (1 + m) after it."""
    bodies = [
        disc([0.0, 0.0], [speed, 0.0], restitution=restitution),
        disc([2 * RADIUS + gap, 0.0], mass=mass),
    ]
    world = PlanarWorld(bodies, DT, substeps)
    coast(world, 4)
    after = speed * np.array([1.0 - mass * restitution, 1.0 + restitution]) / (1.0 + mass)
    exact = engine == "pymunk"  # whose state is float64
    np.testing.assert_allclose(
        world.velocity[:, 0], after, atol=1e-12 if exact else FLOAT32 * speed
    )
    expected = [gap, 2 * RADIUS + gap] + (4 * DT - gap / speed) * after
    # Both see a touch at an overlap, pymunk at 0.3 mm, Box2D at up to 0.5 mm, and turn there.
    late = (4e-4 if exact else 7e-4) * max(1.0 - after[0] / speed, 1.0)
    np.testing.assert_allclose(world.position[:, 0], expected, atol=late)
    assert not world.velocity[:, 1].any() and not world.angle.any()


def test_bodies_that_approach_slowly_do_not_bounce_on_box2d(engine):
    """Box2D's threshold, 1 m/s in its own units, is 3.125 cm/s here; Chipmunk has none."""
    for speed, bounces in [(0.0305, engine == "pymunk"), (0.032, True)]:
        bodies = [disc([0.0, 0.0], [speed, 0.0], restitution=1.0), disc([0.082, 0.0])]
        world = PlanarWorld(bodies, DT)
        coast(world, 4)
        after = [0.0, speed] if bounces else [speed / 2.0] * 2
        np.testing.assert_allclose(world.velocity[:, 0], after, atol=FLOAT32)


@pytest.mark.parametrize(("friction", "other"), [(0.0, 0.0), (0.2, 0.2), (0.1, 0.4), (3.0, 3.0)])
def test_friction_takes_the_mean_coefficient_times_the_impulse_until_sliding_ends(friction, other):
    """A disc grazes a static one: the normal is at 45 degrees, the tangent speed 1.2 m/s."""
    normal, tangent = np.array([1.0, 1.0]) / np.sqrt(2.0), np.array([1.0, -1.0]) / np.sqrt(2.0)
    velocity = 0.8 * normal + 1.2 * tangent
    start = -2 * RADIUS * normal - 0.03 * velocity
    bodies = [disc(start, velocity, friction=friction), disc([0, 0], static=True, friction=other)]
    world = PlanarWorld(bodies, DT, 10)
    coast(world, 1)
    along, across = world.velocity[0] @ normal, world.velocity[0] @ tangent
    lost = min(np.sqrt(friction * other) * 0.8, 1.2)
    assert abs(across - (1.2 - lost)) < 0.01, "the normal at the time of impact is within slop"
    assert abs(along) < 0.01 + 0.2
    assert not world.velocity[1].any() and not world.position[1].any()


def test_a_static_body_reflects_with_the_larger_restitution():
    pillar = disc([0.4, 0.0], static=True, restitution=0.8)
    world = PlanarWorld([disc([0.0, 0.0], [2.0, 0.0], restitution=0.3), pillar], DT)
    coast(world, 6)
    assert world.velocity[0] == pytest.approx([-1.6, 0.0], abs=FLOAT32)
    assert world.position[1].tolist() == [0.4, 0.0] and not world.velocity[1].any()


def test_damping_is_that_of_a_viscous_force():
    world = PlanarWorld([disc([0.0, 0.0], [1.0, -2.0], damping=0.8)], DT)
    coast(world, 20)
    np.testing.assert_allclose(world.velocity[0], np.exp(-0.8) * np.array([1.0, -2.0]), rtol=2e-3)


def test_between_walls_a_disc_goes_to_and_fro():
    """Its path, unfolded, is a straight line: a triangle wave on each axis."""
    walls = np.array([[-0.5, -0.3], [0.7, 0.4]])
    velocity = np.array([0.83, -0.61])
    world = PlanarWorld([disc([0.0, 0.0], velocity, restitution=1.0)], DT, walls=walls)
    low, high = walls[0] + RADIUS, walls[1] - RADIUS
    for step in range(1, 100):
        push(world)
        way = np.mod(step * DT * velocity - low, 2 * (high - low))
        unfolded = low + np.minimum(way, 2 * (high - low) - way)
        np.testing.assert_allclose(world.position[0], unfolded, atol=SLOP * (2 + step * DT))
        np.testing.assert_allclose(np.abs(world.velocity[0]), np.abs(velocity), atol=FLOAT32)
    assert not world.contact.any(), "walls are no nodes"


def test_friction_with_the_ground_decelerates_steadily_and_stops_exactly():
    mu, velocity = 0.3, np.array([0.6, -0.8])
    world = PlanarWorld([disc([0.0, 0.0], velocity, mass=2.5, ground_friction=mu)], DT)
    stop = 1.0 / (mu * GRAVITY)
    for step in range(1, 12):
        push(world)
        speed = max(1.0 - mu * GRAVITY * step * DT, 0.0)
        np.testing.assert_allclose(world.velocity[0], speed * velocity, atol=FLOAT32)
    assert step * DT > stop and not world.velocity.any(), "the disc is at rest, to the last bit"
    # Substeps of h move it by the new speed alone: h / 2 less than the continuous path at 1 m/s.
    way = 0.5 * stop - 0.5 * DT / 10
    np.testing.assert_allclose(world.position[0], way * velocity, atol=1e-4)
    rest = world.position
    coast(world, 20)
    assert np.array_equal(world.position, rest)


def test_a_force_on_the_ground_moves_a_body_only_by_its_excess_over_friction():
    mu, mass = 0.3, 2.0
    limit = mu * mass * GRAVITY
    world = PlanarWorld([disc([0.0, 0.0], mass=mass, ground_friction=mu)], DT)
    for _ in range(10):
        push(world, [0.0, 0.999 * limit])
    assert not world.velocity.any() and not world.position.any()
    for _ in range(10):
        push(world, [0.0, limit + 1.0])
    np.testing.assert_allclose(world.velocity[0], [0.0, 10 * DT / mass], atol=FLOAT32)


@pytest.mark.parametrize("restitution", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_energy_never_grows_among_many_bodies_and_walls(restitution, friction):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 4)] * 2), axis=-1).reshape(-1, 2)
    mass = rng.uniform(0.5, 3.0, len(grid))
    bodies = [
        disc(place, rng.normal(0.0, 1.0, 2), m, restitution=restitution, friction=friction)
        for place, m in zip(grid, mass, strict=True)
    ]
    world = PlanarWorld(bodies, DT, walls=np.array([[-0.4, -0.4], [0.4, 0.4]]))
    before, impacts = energy(mass, world.velocity), 0
    for _ in range(100):
        push(world)
        now = energy(mass, world.velocity)
        assert now <= before * (1.02 if friction and restitution == 1.0 else 1.0 + 1e-5)
        before, impacts = now, impacts + world.contact.any()
    assert impacts > 20
    assert np.abs(world.position).max() < 0.4 - RADIUS + 2 * SLOP


@pytest.fixture(scope="module")
def swept(engine):
    """Body 0 is driven from one to the next of nine others, which stick to all that they touch."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid([-0.2, 0.0, 0.2], [-0.2, 0.0, 0.2]), axis=-1).reshape(-1, 2)
    position = np.concatenate([[[-0.6, 0.02]], grid + rng.uniform(-0.03, 0.03, grid.shape)])
    mass = rng.uniform(0.5, 2.0, len(position))
    bodies = [disc(place, mass=m) for place, m in zip(position, mass, strict=True)]
    world = PlanarWorld(bodies, DT, hold=HoldAtTouch())
    states, forces = [(world.position, world.velocity, world.contact)], []
    for _ in range(200):
        way = world.position - world.position[0]
        way[groups(world.contact)[0]] = np.inf
        nearest = way[np.argmin(np.linalg.norm(way, axis=-1))]
        aim = nearest if np.isfinite(nearest).all() else np.zeros(2)
        force = 20.0 * aim - 3.0 * world.velocity[0] + rng.normal(0.0, 1.0, 2)
        push(world, force)
        states.append((world.position, world.velocity, world.contact))
        forces.append(force)
    position, velocity, contact = (np.stack(each) for each in zip(*states, strict=True))
    return mass, position, velocity, contact, np.stack(forces)


def groups(contact):
    reach = contact | np.eye(len(contact), dtype=bool)
    for _ in range(len(contact)):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def test_momentum_is_conserved_and_the_centre_of_mass_moves_as_if_nothing_had_touched(swept):
    mass, position, velocity, contact, force = swept
    assert groups(contact[-1])[0].sum() >= 5, "the run must sweep up a group"
    momentum = np.einsum("n,tnd->td", mass, velocity)
    np.testing.assert_allclose(np.diff(momentum, axis=0), DT * force, atol=FLOAT32)
    centre = np.einsum("n,tnd->td", mass, position) / mass.sum()
    expected, speed = [centre[0]], np.zeros(2)
    for each in force / mass.sum():
        expected.append(expected[-1] + DT * speed + 11 / 20 * DT**2 * each)
        speed = speed + DT * each
    np.testing.assert_allclose(centre, expected, atol=1e-4)


def test_a_held_group_has_one_velocity_and_keeps_its_shape(swept):
    _, position, velocity, contact, _ = swept
    assert np.array_equal(contact, contact.swapaxes(1, 2))
    assert not np.any(np.diagonal(contact, axis1=1, axis2=2))
    assert not np.any(contact[:-1] & ~contact[1:]), "a hold never ends"
    old = np.array([np.array_equal(*pair) for pair in zip(contact[1:], contact[:-1], strict=True)])
    for step in np.flatnonzero(old) + 1:  # no impact in this step
        if not contact[step].any():
            continue
        together = groups(contact[step])
        difference = np.abs(velocity[step][:, None] - velocity[step]).max(axis=-1)
        assert difference[together].max() < 0.01
        distance = np.linalg.norm(position[step][:, None] - position[step], axis=-1)
        assert np.abs(distance[contact[step]] - 2 * RADIUS).max() < 2e-3


def test_bodies_that_are_joined_share_an_oblique_impact_at_the_latest_one_step_later():
    velocity = np.array([1.0, 0.0])
    world = PlanarWorld([disc([0.0, 0.0], velocity), disc([0.3, 0.05])], DT, hold=HoldAtTouch())
    while not world.holding.any():
        push(world)
    push(world)
    np.testing.assert_allclose(world.velocity, [velocity / 2.0] * 2, atol=1e-4)


@pytest.mark.parametrize(("offset", "hit"), [(0.0790, True), (0.0805, False)])
def test_a_passing_body_is_not_grasped(offset, hit):
    world = PlanarWorld([disc([0.0, 0.0], [0.5, 0.0]), disc([0.3, offset])], DT, hold=HoldAtTouch())
    coast(world, 30)
    assert world.holding[0, 1] == world.contact[0, 1] == hit


@pytest.mark.parametrize("angle", [0.0, 2.2])
def test_a_joint_carries_the_force_that_its_other_body_needs(angle):
    direction = np.array([np.cos(angle), np.sin(angle)])
    world = PlanarWorld([disc([0.0, 0.0]), disc(2 * RADIUS * direction, mass=3.0)], DT)
    world.join(1, 0)
    assert world.holding[0, 1] and not world.joint_force(0, 1).any()
    for force in (8.0 * direction, -8.0 * direction):
        for _ in range(2):
            push(world, force)
        np.testing.assert_allclose(world.joint_force(0, 1), 0.75 * force, rtol=1e-3)
        assert np.array_equal(world.joint_force(0, 1), world.joint_force(1, 0))
    world.part(0, 1)
    assert not world.holding.any() and not world.joint_force(0, 1).any()
    before = world.velocity
    push(world, -8.0 * direction)
    np.testing.assert_allclose(world.velocity[0] - before[0], -0.4 * direction, atol=FLOAT32)
    assert np.array_equal(world.velocity[1], before[1])


def test_parted_bodies_touch_again():
    world = PlanarWorld([disc([0.0, 0.0]), disc([2 * RADIUS, 0.0], mass=3.0)], DT)
    world.join(0, 1)
    coast(world, 2)
    world.part(0, 1)
    world.part(0, 1)
    push(world, [0.1, 0.0])
    assert (0, 1) in world.touching_pairs, "before either has moved by a millimetre"
    for _ in range(19):
        push(world, [10.0, 0.0])
    assert (0, 1) in world.touching_pairs and world.contact[0, 1] and not world.holding[0, 1]
    assert np.linalg.norm(world.position[1] - world.position[0]) > 2 * RADIUS - 2e-3
    np.testing.assert_allclose(world.velocity[:, 0], 19 * DT * 10.0 / 4.0, rtol=2e-3)


def test_a_bounce_within_a_step_is_a_contact_of_that_step_only():
    bodies = [disc([0.0, 0.0], [1.0, 0.0], restitution=1.0), disc([0.12, 0.0])]
    world = PlanarWorld(bodies, DT)
    assert not world.contact.any()
    push(world)  # the touch is after 0.04 s, the next substep begins at 0.045 s
    assert world.contact[0, 1] and world.contact[1, 0] and not world.contact.diagonal().any()
    assert not world.touching_pairs
    push(world)
    assert not world.contact.any()


def test_a_hold_rule_is_asked_after_every_substep():
    class Counted:
        def __init__(self):
            self.calls, self.switches = [], []

        def update(self, world, dt):
            self.calls.append(dt)
            self.switches.append(world.switch)

    rule = Counted()
    world = PlanarWorld([disc([0.1, 0.2])], DT, substeps=4, hold=rule)
    push(world)
    world.switch = 1.0
    push(world)
    assert rule.calls == [DT / 4] * 8 and rule.switches == [0.0] * 4 + [1.0] * 4


def test_a_disc_that_may_rotate_rolls_along_a_rough_body():
    """Friction at its lower side pulls back: it turns clockwise, and v loses what w gains."""
    ground = PlanarBody(
        np.array([0.0, -0.2]), 1.0, half_size=np.array([3.0, 0.2]), static=True, friction=1.0
    )
    body = disc([0.0, RADIUS], [1.0, 0.0], mass=2.0, rotates=True, friction=1.0)
    world = PlanarWorld([body, ground], DT)
    for _ in range(40):
        push(world, [0.0, -20.0])
    # A solid disc that slid ends rolling with two thirds of its speed.
    assert world.velocity[0] == pytest.approx([2.0 / 3.0, 0.0], abs=5e-3)
    assert world.angular_velocity[0] == pytest.approx(-2.0 / 3.0 / RADIUS, rel=1e-2)
    assert world.angle[0] < -1.0 and world.angle[1] == 0.0
    assert abs(world.position[0, 1] - RADIUS) < 2 * SLOP


def test_bodies_of_one_negative_group_pass_through_one_another():
    bodies = [disc([0.0, 0.0], [1.0, 0.0], group=-1), disc([0.2, 0.0], group=-1)]
    world = PlanarWorld(bodies, DT)
    coast(world, 10)
    assert world.position[0, 0] == pytest.approx(0.5, abs=FLOAT32)
    assert not world.contact.any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: disc([0, 0], mass=0.0), "mass of a body must be above 0 kg, found 0.0"),
        (
            lambda: disc([0, 0], restitution=1.1),
            "restitution of a body must be in 0 to 1, found 1.1",
        ),
        (lambda: disc([0, 0], friction=-0.1), "friction of a body must be at least 0, found -0.1"),
        (lambda: disc([0, 0], damping=-1.0), "damping of a body must be at least 0 1/s, found -1"),
        (lambda: disc([0, 0], ground_friction=0.1, rotates=True), "ground_friction is for bodies"),
        (lambda: disc([0, 0], half_size=np.ones(2)), "either a radius or a half_size"),
        (lambda: PlanarBody(np.zeros(2), 1.0), "either a radius or a half_size"),
        (
            lambda: PlanarBody(np.zeros(2), 1.0, half_size=np.array([0.1, 0.0])),
            r"size of a body must be at least 0.001 m, found",
        ),
        (lambda: PlanarWorld([disc([0, 0])], DT, 0), "substeps must be at least 1, found 0"),
    ],
)
def test_numbers_out_of_range(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.parametrize("start", [-0.9, -0.913, -0.931])
@pytest.mark.parametrize("offset", [0.0, 0.03, 0.06, 0.075])
def test_nothing_passes_through_a_disc_a_box_or_a_wall_at_12_metres_a_second(start, offset):
    """At a closing speed of 12 m/s, a disc moves by its diameter in 7 ms, a part of a substep."""
    fast = disc([start, offset], [12.0, 0.0])
    struck = disc([0.0, 0.0])
    world = PlanarWorld([fast, struck], DT)
    coast(world, 3)
    assert world.contact.any() or world.velocity[1].any(), "they have met"
    # The normal is that of the moment of touch: what goes along it is shared by equal masses.
    normal = np.array([np.sqrt((2 * RADIUS) ** 2 - offset**2), -offset]) / (2 * RADIUS)
    expected = 6.0 * normal[0] * normal
    np.testing.assert_allclose(world.velocity[1], expected, atol=0.02 * 12.0)
    bar = PlanarBody(np.zeros(2), 1.0, half_size=np.array([0.01, 0.2]), static=True)
    wall = np.array([[-2.0, -2.0], [0.01, 2.0]])
    for stopped in (PlanarWorld([fast, bar], DT), PlanarWorld([fast], DT, walls=wall)):
        coast(stopped, 3)
        assert stopped.position[0, 0] < 0.0 and abs(stopped.velocity[0, 0]) < 1e-3


def test_a_copy_of_a_world_goes_on_to_the_last_bit_and_leaves_the_first_alone():
    rng = np.random.default_rng(3)
    bodies = [disc([0.09 * i, 0.1 * (i % 2)], ground_friction=0.05 * i) for i in range(5)]
    world = PlanarWorld(bodies, DT, hold=HoldAtTouch())
    forces = rng.normal([4.0, 1.0], 4.0, (40, 2))
    for force in forces[:15]:
        push(world, force)
    before = world.position
    other = copy.deepcopy(world)
    for force in forces[15:]:
        push(other, force)
    assert np.array_equal(world.position, before) and world.holding.any()
    for force in forces[15:]:
        push(world, force)
    assert np.array_equal(world.position, other.position)
    assert np.array_equal(world.velocity, other.velocity)
    assert np.array_equal(world.holding, other.holding)


def test_an_engine_that_is_unknown_or_not_installed_is_refused(monkeypatch):
    with pytest.raises(InvalidInputError, match=r"engine must be one of \w+, found 'bullet'"):
        PlanarWorld([disc([0.0, 0.0])], DT, engine="bullet")
    monkeypatch.setattr(engines, "ENGINES", {"box2d": "no_such_module"})
    with pytest.raises(InvalidInputError, match="engine box2d is not installed: pip install box2d"):
        PlanarWorld([disc([0.0, 0.0])], DT, engine="box2d")
    with pytest.raises(InvalidInputError, match="planar tasks need box2d or pymunk: pip install"):
        PlanarWorld([disc([0.0, 0.0])], DT)
