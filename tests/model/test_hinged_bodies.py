"""Hinged bodies: Jacobians against rigid rotation, closest points, and their geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import jitted_geometry

from contactgraph.model.shapes import HingedBodies

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
    edges = jitted_geometry(*states, jnp.array([[0], [1]]), 0.05, 0.08, None, jnp.asarray(ANCHOR))
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
    edges = jitted_geometry(*states, jnp.array([[0], [1]]), 0.05, 0.08, None, jnp.asarray(ANCHOR))
    np.testing.assert_allclose(edges.predicted_distance, edges.distance, rtol=1e-9)
    assert edges.fraction_after_impact[0] == 0
