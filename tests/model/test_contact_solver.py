"""Masses, dampers and springs solved together: by a dense solve, and by conservation laws."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import geometry_of

from contactgraph.bodies.geometry import Geometry
from contactgraph.dynamics.contacts import Contacts
from contactgraph.dynamics.free_bodies import ContactMotion, FreeBodies

pytestmark = pytest.mark.usefixtures("double_precision")
DT, TOUCH = 0.05, 0.08
STIFF = 1e7
"""A damper, kg, against masses of about 1: as good as rigid."""


PAIR = np.array([[0, 1]])
ALL = np.array(list(itertools.combinations(range(6), 2)))
"""All pairs of six nodes: what the tests of smaller groups solve as well, compiled once."""


Network = dict[str, jax.Array]
"""Masses and what joins them."""


def network(mass, pairs, **values) -> Network:
    """What is not given is 0."""
    sizes = dict.fromkeys(("damper", "spring", "rest_length", "displacing_fraction"), len(pairs))
    full = {
        name: jnp.asarray(np.broadcast_to(np.asarray(values.get(name, 0.0), float), (size,)))
        for name, size in {**sizes, "ground_damper": len(mass)}.items()
    }
    return {"mass": jnp.asarray(mass, float), **full}


def solution(
    net: Network, velocity: jax.Array, gain: jax.Array, around: Geometry, smooth: bool
) -> ContactMotion:
    """A step in which all edges hold."""
    (count, dimension), nothing = velocity.shape, 0.0 * net["damper"]
    mass = net["mass"][:, None] * jnp.ones(dimension)
    bodies = FreeBodies(
        mass=mass,
        velocity=velocity,
        ground_damper=net["ground_damper"] / net["mass"],
        deceleration=jnp.zeros(count),
        weight=jnp.zeros((count, dimension, 1)),
        driving=gain[:, None, None] * jnp.eye(dimension),
        push=jnp.zeros((count, dimension, 1)),
    )
    contacts = Contacts(
        geometry=around.along(nothing + 1.0),
        damper=net["damper"],
        spring=net["spring"],
        rest_length=net["rest_length"],
        touching=nothing,
        displacing_fraction=net["displacing_fraction"],
        acting=nothing + 1.0,
        bounce=nothing,
        friction=nothing,
        until_impact=nothing,
        pinned=nothing,
    )
    return contacts.solve(bodies, DT, None, not smooth)


@eqx.filter_jit
def _solve(net, position, velocity, pairs, anchor, gain, smooth) -> tuple[ContactMotion, Geometry]:
    around = geometry_of(position, velocity, pairs.T, DT, TOUCH, anchor=anchor)
    return solution(net, velocity, gain, around, smooth), around


def solve(
    net: Network, position, velocity, pairs, anchor=None, gain=None, smooth=True
) -> tuple[ContactMotion, Geometry]:
    gain = np.zeros(len(velocity)) if gain is None else gain
    arrays = [np.asarray(given, float) for given in (position, velocity)]
    hinges = None if anchor is None else np.asarray(anchor)
    return _solve(net, *arrays, np.asarray(pairs), hinges, np.asarray(gain, float), smooth)


def plain_jacobian(position, pairs, anchor) -> np.ndarray:
    """[E D, N D]: every edge's relative velocity, from every node's."""
    count, D = position.shape
    jacobian = np.zeros((len(pairs), D, count, D))
    for edge, (first, second) in enumerate(pairs):
        for sign, own, other in ((-1, first, second), (1, second, first)):
            edge_jacobian = np.eye(D)
            if anchor is not None and np.isfinite(anchor[own, 0]):
                arm, reach = position[own] - anchor[own], position[other] - anchor[own]
                edge_jacobian = (arm @ reach * np.eye(D) - np.outer(arm, reach)) / (arm @ arm)
            jacobian[edge, :, own] = sign * edge_jacobian
    return jacobian.reshape(len(pairs) * D, count * D)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("hinges", [False, True])
def test_a_step_is_a_plain_solve(dimension: int, hinges: bool, smooth: bool) -> None:
    """Also by the law of bodies that bounce and rub, where none does."""
    rng = np.random.default_rng(0)
    count, pairs = 5, np.array(list(itertools.combinations(range(5), 2)))
    position, velocity = rng.normal(size=(2, count, dimension))
    anchor = None
    if hinges:
        anchor = np.full((count, dimension), np.nan)
        anchor[[1, 3]] = rng.normal(size=(2, dimension))
    mass, ground, gain = rng.uniform(0.5, 3, count), rng.uniform(0, 1, count), rng.uniform(0, 1, 5)
    hold, spring, rest, displacing_fraction = rng.uniform(0, 5, (4, len(pairs)))
    net = network(
        mass,
        pairs,
        ground_damper=ground,
        damper=hold,
        spring=spring,
        rest_length=rest,
        displacing_fraction=displacing_fraction,
    )
    found, around = solve(net, position, velocity, pairs, anchor, gain, smooth)

    J = plain_jacobian(position, pairs, anchor)
    along = np.repeat(hold + spring, dimension)
    H = np.diag(np.repeat(mass + ground, dimension)) + J.T @ np.diag(along) @ J
    relative = J @ velocity.reshape(-1)
    displacement, direction = np.asarray(around.displacement), np.asarray(around.direction)
    stretch = (displacement - rest[:, None] * direction).reshape(-1)
    pulled = np.repeat(spring, dimension) * stretch / DT
    force = J.T @ (along * relative + pulled) + np.repeat(ground, dimension) * velocity.reshape(-1)
    shift = -DT * np.linalg.solve(
        H, J.T @ (np.repeat(displacing_fraction * hold, dimension) * relative)
    )
    control_displacement = np.linalg.solve(H, np.kron(gain[:, None], np.eye(dimension)))
    # Friction of 0 is a damper of 1e-6 of that along the normal; holds have none.
    close = {"rtol": 1e-9, "atol": 1e-12}
    np.testing.assert_allclose(
        found.velocity_change.reshape(-1), -np.linalg.solve(H, force), **close
    )
    np.testing.assert_allclose(found.impact_displacement.reshape(-1), shift, **close)
    np.testing.assert_allclose(found.response.reshape(-1, dimension), control_displacement, **close)
    own = np.diag(np.linalg.inv(H)).reshape(count, dimension)
    np.testing.assert_allclose(found.own_share, own * mass[:, None], **close)
    np.testing.assert_allclose(found.ground_share, own * ground[:, None], **close)


def topologies() -> list:
    cases = []
    for count in range(2, 7):
        rng = np.random.default_rng(count)
        chain = [(i, i + 1) for i in range(count - 1)]
        shapes = {
            "chain": chain,
            "ring": [*chain, (count - 1, 0)] if count > 2 else chain,
            "star": [(0, i) for i in range(1, count)],
            "tree": [(int(rng.integers(i)), i) for i in range(1, count)],
            "all": list(itertools.combinations(range(count), 2)),
        }
        cases += [pytest.param(pairs, id=f"{name}-{count}") for name, pairs in shapes.items()]
    return cases


@pytest.mark.parametrize("pairs", topologies())
def test_coupled_nodes_share_momentum_in_any_topology(pairs) -> None:
    rng = np.random.default_rng(len(pairs))
    mass = rng.uniform(0.3, 5.0, 6)
    position, velocity = rng.normal(size=(2, 6, 2))
    momentum = mass @ velocity
    held = np.array([tuple(pair) in {tuple(sorted(p)) for p in pairs} for pair in ALL])
    for hold in (0.1, 10.0, STIFF):  # Momentum is kept however hard the edges hold.
        found, _ = solve(network(mass, ALL, damper=hold * held), position, velocity, ALL)
        np.testing.assert_allclose(mass @ (velocity + found.velocity_change), momentum, atol=1e-6)
    group = 1 + max(map(max, pairs))
    mass, velocity, change = mass[:group], velocity[:group], np.asarray(found.velocity_change)
    common = np.tile(mass @ velocity / mass.sum(), (group, 1))
    np.testing.assert_allclose(velocity + change[:group], common, atol=1e-5)
    np.testing.assert_allclose(found.own_share[:group, 0], mass / mass.sum(), atol=1e-5)
    assert not np.any(change[group:]), "uncoupled nodes move on unchanged"


def test_uncoupled_nodes_do_not_move() -> None:
    pairs = [(0, 1), (2, 3)]
    position, velocity = np.random.default_rng(0).normal(size=(2, 4, 2))
    net = network([1.0, 2.0, 3.0, 4.0], pairs, damper=[STIFF, 0.0])
    found, _ = solve(net, position, velocity, pairs, gain=[1, 0, 0, 0])
    assert np.any(found.velocity_change[:2]) and not np.any(found.velocity_change[2:])
    assert np.any(found.response[:2]) and not np.any(found.response[2:])
    np.testing.assert_array_equal(found.own_share[2:], 1.0)


@pytest.mark.parametrize("hinges", [False, True])
def test_kinetic_energy_never_grows(hinges: bool) -> None:
    rng = np.random.default_rng(1)
    position = rng.normal(size=(6, 2))
    anchor = np.full((6, 2), np.nan)
    anchor[[1, 2]] = position[[1, 2]] + rng.normal(size=(2, 2))
    lost = []
    for _ in range(200):
        mass, ground = 10.0 ** rng.uniform(-2, 2, 6), 10.0 ** rng.uniform(-6, 3, 6)
        hold = 10.0 ** rng.uniform(-4, 4, len(ALL)) * (rng.random(len(ALL)) < 0.3)
        velocity = rng.normal(size=(6, 2))
        net = network(mass, ALL, ground_damper=ground, damper=hold)
        found, _ = solve(net, position, velocity, ALL, anchor if hinges else None)
        after = velocity + np.asarray(found.velocity_change)
        before, left = (np.sum(mass[:, None] * v**2) for v in (velocity, after))
        assert left <= before * (1 + 1e-12)
        lost.append(1 - left / before)
    assert max(lost) > 0.5, "something must happen for this to say anything"


def test_rubbing_against_the_ground_by_hand() -> None:
    velocity = np.array([[2.0, 0.0], [0.0, -3.0]])
    net = network([1.0, 4.0], PAIR, ground_damper=[0.25, 1.0])
    found, _ = solve(net, np.eye(2), velocity, PAIR)
    # Implicitly: m (v' - v) = -g v'.
    np.testing.assert_allclose(found.velocity_change, -velocity / 5)
    np.testing.assert_allclose(found.ground_share, 0.2)
    assert not np.any(found.impact_displacement)


def test_what_the_ground_takes_of_what_is_coupled() -> None:
    """A fraction of each body's own velocity, not more than all of it."""
    net = network([1.0, 4.0], PAIR, ground_damper=[0.25, 1e9], damper=STIFF)
    found, _ = solve(net, np.eye(2), np.ones((2, 2)), PAIR)
    np.testing.assert_allclose(found.velocity_change, -1.0, atol=1e-6)


def test_a_spring_by_hand() -> None:
    """Two bodies at rest on a stretched spring, with its force at the end of the step."""
    mass, spring, stretch = np.array([1.0, 2.0]), 0.6, 0.03
    still = np.zeros((2, 2))
    position = np.array([[0.0, 0.0], [0.1 + stretch, 0.0]])
    net = network(mass, PAIR, spring=spring, rest_length=0.1)
    found = np.asarray(solve(net, position, still, PAIR)[0].velocity_change)
    stiffness = spring / DT**2
    force = stiffness * (stretch + DT * (found[1, 0] - found[0, 0]))
    np.testing.assert_allclose(found[:, 0], DT * force / mass * [1, -1], rtol=1e-9)
    assert found[0, 0] > 0.1 and not np.any(found[:, 1])


def test_an_impact_in_the_middle_of_a_step_by_hand() -> None:
    velocity = np.array([[1.0, 0.0], [0.0, 0.0]])
    net = network([1.0, 1.0], PAIR, damper=STIFF, displacing_fraction=0.4)
    found, _ = solve(net, [[0.0, 0.0], [0.1, 0.0]], velocity, PAIR)
    # Each changes by half the approach; 0.4 of the step longer than the step itself knows.
    np.testing.assert_allclose(found.velocity_change[:, 0], [-0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(
        found.impact_displacement[:, 0], [-0.4 * DT * 0.5, 0.4 * DT * 0.5], atol=1e-9
    )


def test_a_grasped_pair_responds_to_the_control_as_one_body() -> None:
    masses = (1.5, 2.5)
    still = np.zeros((2, 2))
    states = [[0.0, 0.0], [0.1, 0.0]], still
    held, free = (
        solve(network(masses, PAIR, damper=hold), *states, PAIR, None, [1, 0])[0]
        for hold in (STIFF, 0.0)
    )
    np.testing.assert_allclose(held.response, [np.eye(2) / sum(masses)] * 2, atol=1e-6)
    np.testing.assert_allclose(free.response, [np.eye(2) / 1.5, np.zeros((2, 2))])


@pytest.mark.parametrize("hold", [0.3, STIFF])
def test_a_door_and_its_gripper_keep_their_angular_momentum(hold: float) -> None:
    hinge, arm = np.array([0.3, -0.2]), np.array([0.3, 0.4])
    gripper = hinge + 1.6 * arm + np.array([0.8, -0.6]) * 0.04  # It touches the bar's side.
    position = np.stack([gripper, hinge + arm])
    velocity = np.array([[0.7, -1.1], -0.9 * np.array([-0.4, 0.3])])
    mass = np.array([1.0, 16 / 3])
    anchor = np.array([[np.nan, np.nan], hinge])
    found, _ = solve(network(mass, PAIR, damper=hold), position, velocity, PAIR, anchor, [1, 0])
    after = velocity + np.asarray(found.velocity_change)
    reach = position - hinge

    def cross(one, other):
        return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]

    before = np.sum(mass * cross(reach, velocity))
    np.testing.assert_allclose(np.sum(mass * cross(reach, after)), before, rtol=1e-7)
    assert abs(after[1] @ arm) < 1e-7, "the door only turns"
    if hold == STIFF:
        # Pinned, the gripper moves with the material of the door.
        turning = cross(arm, after[1]) / (arm @ arm)
        np.testing.assert_allclose(
            after[0], turning * np.array([-reach[0, 1], reach[0, 0]]), atol=1e-6
        )
        # Pushed, the two accelerate as one body about the hinge.
        inertia = np.sum(mass * np.sum(reach**2, axis=-1))
        force = np.array([0.4, 0.9])
        pushed = np.asarray(found.response) @ force
        np.testing.assert_allclose(
            cross(arm, pushed[1]) / (arm @ arm), cross(reach[0], force) / inertia, rtol=1e-6
        )
