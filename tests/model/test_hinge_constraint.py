"""The springs that keep hinged and attached bodies on circles."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import jitted_geometry

from contactgraph.model.shapes import HingeConstraint, hinge_constraint

pytestmark = pytest.mark.usefixtures("double_precision")
HINGE, ARM = np.array([0.5, 0.5]), np.array([0.3, 0.4])
OTHER = np.array([2.0, 0.5])
ANCHOR = np.array([[np.nan, np.nan], HINGE, [np.nan, np.nan], OTHER])
"""A gripper, a door, a distractor, and another door; the gripper's edges to the doors."""
PAIRS = np.array([[0, 1], [0, 3], [2, 1]])
SPIN = np.array([0.7, -1.3])
"""rad/s"""
jitted_constraint = eqx.filter_jit(hinge_constraint)


def across(arm: np.ndarray) -> np.ndarray:
    return np.array([-arm[1], arm[0]])


def scene(slip: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Doors turn; the gripper moves with the first, `slip` [m/s] apart."""
    door, other = HINGE + ARM, OTHER + np.array([0.0, 0.5])
    gripper = HINGE + np.array([0.5, 0.5])
    position = np.stack([gripper, door, [9.0, 9.0], other])
    velocity = np.stack(
        [
            SPIN[0] * across(gripper - HINGE) + [slip, 0.0],
            SPIN[0] * across(ARM),
            [1.0, 0.0],
            SPIN[1] * across(other - OTHER),
        ]
    )
    return position, velocity


def circles(hold, slip: float = 0.0) -> HingeConstraint:
    states = [jnp.asarray(values) for values in scene(slip)]
    edges = jitted_geometry(*states, jnp.asarray(PAIRS).T, 0.05, 0.08, None, jnp.asarray(ANCHOR))
    return jitted_constraint(
        jnp.asarray(ANCHOR), *states, np.array(hold), edges.edge_index, edges.relative_velocity
    )


@pytest.mark.slow
def test_a_hinge_spring_supplies_the_centripetal_force() -> None:
    position, velocity = scene()
    found = circles([0.0, 0.0, 0.0])
    for door in (1, 3):
        speed = np.linalg.norm(velocity[door])
        pull = found.stiffness_rate[door] * np.linalg.norm(position[door] - found.center[door])
        radius = np.linalg.norm(position[door] - ANCHOR[door])
        np.testing.assert_allclose(found.center[door], ANCHOR[door])
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
    np.testing.assert_allclose(found.center[0], HINGE)
    np.testing.assert_allclose(found.radius[0], np.hypot(0.5, 0.5), rtol=1e-6)
    np.testing.assert_allclose(found.strength, [1.0, 1.0, 0.0, 1.0])


def test_half_a_coupling_is_half_a_spring() -> None:
    found = circles([0.5, 0.0, 0.0])
    np.testing.assert_allclose(found.stiffness_rate[0], 0.5 * SPIN[0] ** 2)
    np.testing.assert_allclose(found.strength[0], 0.5)


def test_two_doors_share_an_attached_node() -> None:
    found = circles([1.0, 1.0, 0.0])
    np.testing.assert_allclose(found.stiffness_rate[0], np.mean(SPIN**2))
    np.testing.assert_allclose(found.center[0], (HINGE + OTHER) / 2)


def test_a_node_just_struck_is_not_yet_projected() -> None:
    assert circles([1.0, 0.0, 0.0], slip=2.0).strength[0] < 0.01
    assert circles([1.0, 0.0, 0.0], slip=1e-3).strength[0] > 0.99


def test_projection_returns_positions_to_their_circles() -> None:
    position, velocity = scene()
    found = circles([1.0, 0.0, 0.0])
    drifted = jnp.asarray(position + 0.05 * velocity)  # Straight on, off the circle.
    kept = np.asarray(drifted + found.projection(drifted))
    for node, centre in ((0, HINGE), (1, HINGE), (3, OTHER)):
        radius = np.linalg.norm(position[node] - centre)
        assert np.linalg.norm(drifted[node] - centre) > radius + 1e-4
        np.testing.assert_allclose(np.linalg.norm(kept[node] - centre), radius, rtol=1e-7)
        # In the same direction from the hinge.
        arms = kept[node] - centre, np.asarray(drifted)[node] - centre
        assert abs(arms[0] @ across(arms[1])) < 1e-12
    np.testing.assert_array_equal(kept[2], drifted[2])
