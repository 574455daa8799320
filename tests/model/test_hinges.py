"""Hinged bodies: Jacobians against rigid rotation, nearest points, springs that keep circles."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import jitted_geometry

from contactgraph.bodies.shapes import HingedBodies
from contactgraph.dynamics.hinges import HingeConstraint, hinge_constraint

pytestmark = pytest.mark.usefixtures("double_precision")
HINGE, ARM = np.array([0.2, -0.1]), np.array([0.3, 0.4])
ANCHOR = np.array([[np.nan, np.nan], HINGE])
POSITION = np.array([[0.9, 0.7], HINGE + ARM])
BAR, FREE = jnp.array([1]), jnp.array([0])


def bars() -> HingedBodies:
    return HingedBodies(jnp.asarray(POSITION), jnp.asarray(ANCHOR))


contact_jacobian = jax.jit(HingedBodies.contact_jacobian)
closest_point = jax.jit(HingedBodies.closest_point)


def jacobian(point, node=BAR) -> np.ndarray:
    return np.asarray(contact_jacobian(bars(), node, np.asarray(point)[None]))[0]


def turned(vector, angle) -> np.ndarray:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine], [sine, cosine]]) @ vector


@pytest.mark.parametrize("point", [[0.5, 0.2], [0.2, 0.6], [-0.4, 0.3], HINGE, HINGE + ARM])
def test_a_lever_is_that_of_a_rigid_rotation(point) -> None:
    reach, angle = np.asarray(point) - HINGE, 1e-6
    arm_moved = (turned(ARM, angle) - turned(ARM, -angle)) / 2
    point_moved = (turned(reach, angle) - turned(reach, -angle)) / 2
    np.testing.assert_allclose(jacobian(point) @ arm_moved, point_moved, atol=1e-15)


def test_a_lever_in_space_is_that_of_a_rigid_rotation() -> None:
    rng = np.random.default_rng(0)
    hinge, arm, reach, spin = rng.normal(size=(4, 3))
    # About any axis across the arm, and for a point in the plane in which the arm turns.
    spin -= (spin @ arm) / (arm @ arm) * arm
    reach -= (reach @ spin) / (spin @ spin) * spin
    one = HingedBodies(jnp.asarray(hinge + arm)[None], jnp.asarray(hinge)[None])
    found = np.asarray(contact_jacobian(one, FREE, (hinge + reach)[None]))[0]
    np.testing.assert_allclose(found @ np.cross(spin, arm), np.cross(spin, reach), atol=1e-12)


def test_the_hinge_bears_forces_along_the_radius() -> None:
    rng = np.random.default_rng(0)
    for point, force in zip(rng.normal(size=(20, 2)), rng.normal(size=(20, 2)), strict=True):
        at_node = jacobian(point).T @ force
        assert abs(at_node @ ARM) < 1e-12
        # What is left turns the node about the hinge as the force turns the bar.
        reach = point - HINGE
        torque = reach[0] * force[1] - reach[1] * force[0]
        assert ARM[0] * at_node[1] - ARM[1] * at_node[0] == pytest.approx(torque)


def test_without_a_hinge_a_node_is_its_only_point() -> None:
    np.testing.assert_array_equal(jacobian([5.0, 3.0], FREE), np.eye(2))
    place, slides = map(np.asarray, closest_point(bars(), FREE, np.array([[5.0, 3.0]])))
    np.testing.assert_array_equal(place[0], POSITION[0])
    assert not np.any(slides)


@pytest.mark.parametrize(
    ("along", "across", "expected"),
    [
        (0.4, 0.3, 0.4),
        (1.9, -0.2, 1.9),
        (-0.5, 0.1, 0.0),  # Beyond the hinge.
        (2.7, -0.3, 2.0),  # Beyond the free end, twice the arm away from the hinge.
    ],
)
def test_the_nearest_point_of_a_bar(along, across, expected) -> None:
    side = np.array([-0.8, 0.6])
    point = HINGE + along * ARM + across * side
    place, slides = map(np.asarray, closest_point(bars(), BAR, point[None]))
    np.testing.assert_allclose(place[0], HINGE + expected * ARM, atol=1e-12)
    inside = along == expected
    np.testing.assert_allclose(slides[0], inside * ARM / 0.5, atol=1e-12)
    # No point of the bar is nearer.
    bar = HINGE + np.linspace(0, 2, 20_001)[:, None] * ARM
    least = np.linalg.norm(bar - point, axis=-1).min()
    assert np.linalg.norm(place[0] - point) == pytest.approx(least, abs=1e-6)


def test_a_node_on_its_own_hinge_is_finite() -> None:
    degenerate = HingedBodies(jnp.asarray([[0.2, -0.1]]), jnp.asarray([HINGE]))
    point = jnp.array([[0.3, 0.1]])
    found = (
        contact_jacobian(degenerate, FREE, point),
        *closest_point(degenerate, FREE, point),
    )
    for leaf in found:
        assert np.all(np.isfinite(leaf))


def test_contact_with_a_hinged_bar_is_at_its_nearest_point() -> None:
    """A body that strikes the bar's side at three quarters of its length."""
    side = np.array([-0.8, 0.6])
    body = HINGE + 1.5 * ARM + 0.1 * side
    spin = 0.8  # rad/s
    velocity = np.stack([-1.0 * side, spin * np.array([-ARM[1], ARM[0]])])
    states = jnp.asarray([body, HINGE + ARM]), jnp.asarray(velocity)
    edges = jitted_geometry(*states, jnp.array([[0], [1]]), 0.05, 0.08, anchor=jnp.asarray(ANCHOR))
    np.testing.assert_allclose(edges.distance, [0.1], rtol=1e-6)
    np.testing.assert_allclose(edges.direction, [-side], atol=1e-6)
    # The material at the point turns with the bar, at 0.75 m from the hinge (and 0.1 beside it).
    reach = body - HINGE
    material = spin * np.array([-reach[1], reach[0]])
    np.testing.assert_allclose(edges.relative_velocity, [material - velocity[0]], atol=1e-12)
    closing = (material - velocity[0]) @ side
    assert closing == pytest.approx(1.0 + 0.75 * spin)
    np.testing.assert_allclose(edges.fraction_after_impact, [1 - 0.02 / closing / 0.05], atol=1e-3)


def test_sliding_along_a_bar_brings_nothing_nearer() -> None:
    side = np.array([-0.8, 0.6])
    body = HINGE + 1.0 * ARM + 0.1 * side
    velocity = np.stack([3.0 * ARM, 0 * ARM])
    states = jnp.asarray([body, HINGE + ARM]), jnp.asarray(velocity)
    edges = jitted_geometry(*states, jnp.array([[0], [1]]), 0.05, 0.08, anchor=jnp.asarray(ANCHOR))
    np.testing.assert_allclose(edges.closest_approach, edges.distance, rtol=1e-9)
    assert edges.fraction_after_impact[0] == 0


FIRST, OTHER = np.array([0.5, 0.5]), np.array([2.0, 0.5])
ANCHORS = np.array([[np.nan, np.nan], FIRST, [np.nan, np.nan], OTHER])
"""A gripper, a door, a distractor, and another door; the gripper's edges to the doors."""
PAIRS = np.array([[0, 1], [0, 3], [2, 1]])
SPIN = np.array([0.7, -1.3])
"""rad/s"""
jitted_constraint = eqx.filter_jit(hinge_constraint)


def across(arm: np.ndarray) -> np.ndarray:
    return np.array([-arm[1], arm[0]])


def scene(slip: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Doors turn; the gripper moves with the first, `slip` [m/s] apart."""
    door, other = FIRST + ARM, OTHER + np.array([0.0, 0.5])
    gripper = FIRST + np.array([0.5, 0.5])
    position = np.stack([gripper, door, [9.0, 9.0], other])
    velocity = np.stack(
        [
            SPIN[0] * across(gripper - FIRST) + [slip, 0.0],
            SPIN[0] * across(ARM),
            [1.0, 0.0],
            SPIN[1] * across(other - OTHER),
        ]
    )
    return position, velocity


def circles(hold, slip: float = 0.0) -> HingeConstraint:
    states = [jnp.asarray(values) for values in scene(slip)]
    edges = jitted_geometry(*states, jnp.asarray(PAIRS).T, 0.05, 0.08, anchor=jnp.asarray(ANCHORS))
    return jitted_constraint(jnp.asarray(ANCHORS), *states, np.array(hold), edges)


@pytest.mark.slow
def test_a_hinge_spring_supplies_the_centripetal_force() -> None:
    position, velocity = scene()
    found = circles([0.0, 0.0, 0.0])
    for door in (1, 3):
        speed = np.linalg.norm(velocity[door])
        pull = found.stiffness_rate[door] * np.linalg.norm(position[door] - found.center[door])
        radius = np.linalg.norm(position[door] - ANCHORS[door])
        np.testing.assert_allclose(found.center[door], ANCHORS[door])
        np.testing.assert_allclose(pull, speed**2 / radius)
    np.testing.assert_allclose(found.stiffness_rate[jnp.array([1, 3])], SPIN**2)


def test_a_free_unattached_node_has_no_spring() -> None:
    position, _ = scene()
    found = circles([0.0, 0.0, 0.0])
    assert not np.any(found.stiffness_rate[jnp.array([0, 2])])
    np.testing.assert_array_equal(found.center[0], position[0])
    np.testing.assert_array_equal(found.center[2], position[2])
    moved = jnp.asarray(position) + 0.1
    assert not np.any(found.projection(moved)[jnp.array([0, 2])])


def test_nodes_attached_to_a_door_turn_with_it() -> None:
    found = circles([1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.stiffness_rate[0], SPIN[0] ** 2)
    np.testing.assert_allclose(found.center[0], FIRST)
    np.testing.assert_allclose(found.radius[0], np.hypot(0.5, 0.5), rtol=1e-6)
    np.testing.assert_allclose(found.strength, [1.0, 1.0, 0.0, 1.0])


def test_half_a_coupling_is_half_a_spring_and_two_doors_share_a_node() -> None:
    half, two = circles([0.5, 0.0, 0.0]), circles([1.0, 1.0, 0.0])
    np.testing.assert_allclose(half.stiffness_rate[0], 0.5 * SPIN[0] ** 2)
    np.testing.assert_allclose(half.strength[0], 0.5)
    np.testing.assert_allclose(two.stiffness_rate[0], np.mean(SPIN**2))
    np.testing.assert_allclose(two.center[0], (FIRST + OTHER) / 2)


def test_a_node_just_struck_is_not_yet_projected() -> None:
    assert circles([1.0, 0.0, 0.0], slip=2.0).strength[0] < 0.01
    assert circles([1.0, 0.0, 0.0], slip=1e-3).strength[0] > 0.99


def test_projection_returns_positions_to_their_circles() -> None:
    position, velocity = scene()
    found = circles([1.0, 0.0, 0.0])
    drifted = jnp.asarray(position + 0.05 * velocity)  # Straight on, off the circle.
    kept = np.asarray(drifted + found.projection(drifted))
    for node, centre in ((0, FIRST), (1, FIRST), (3, OTHER)):
        radius = np.linalg.norm(position[node] - centre)
        assert np.linalg.norm(drifted[node] - centre) > radius + 1e-4
        np.testing.assert_allclose(np.linalg.norm(kept[node] - centre), radius, rtol=1e-7)
        # In the same direction from the hinge.
        arms = kept[node] - centre, np.asarray(drifted)[node] - centre
        assert abs(arms[0] @ across(arms[1])) < 1e-12
    np.testing.assert_array_equal(kept[2], drifted[2])
