"""Boxes along the axes, against MuJoCo's distances and by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.test_util import check_grads
from model_scenes import geometry_of

from contactgraph.bodies.shapes import box_displacement
from contactgraph.data.trajectory import box_distance

HALF = np.array([0.1, 0.2, 0.05])
DT = 0.04
displaced = jax.jit(box_displacement)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.4, 0.4, (500, 3)).astype(np.float32)


def test_the_gap_to_a_box_is_mujocos(points: np.ndarray) -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='box' size='0.1 0.2 0.05'/><body name='ball'>"
        "<freejoint/><geom type='sphere' size='0.01'/></body></worldbody></mujoco>"
    )
    data, gaps = mujoco.MjData(model), []
    for point in points:
        data.qpos[:3] = point
        mujoco.mj_forward(model, data)
        gaps.append(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + 0.01)
    outside = np.any(np.abs(points) > HALF, axis=1)
    moved, _ = displaced(points, np.broadcast_to(HALF, points.shape))
    found = np.linalg.norm(moved, axis=1) - HALF.min()
    np.testing.assert_allclose(found[outside], np.array(gaps)[outside], atol=1e-5)
    np.testing.assert_allclose(box_distance(points, HALF) - HALF.min(), found, atol=1e-6)


def test_a_ball_stays_as_it_is_and_slides_nowhere(points: np.ndarray) -> None:
    moved, sliding = displaced(points, np.zeros_like(points))
    np.testing.assert_array_equal(moved, points)
    assert not np.any(sliding)


def test_within_a_box_the_nearest_side_counts() -> None:
    moved, sliding = displaced(np.array([[0.02, -0.19, 0.01]]), HALF[None])
    np.testing.assert_allclose(moved, [[0.0, -(0.05 - 0.01), 0.0]], atol=1e-7)
    np.testing.assert_array_equal(np.array(sliding)[:, 0], np.diag([1.0, 0.0, 1.0]))
    middle, _ = displaced(np.zeros((1, 3)), HALF[None])
    np.testing.assert_allclose(middle, 0.0, atol=1e-7)


def _met(position, velocity) -> tuple[float, np.ndarray]:
    found = geometry_of(
        jnp.stack([jnp.zeros(2), position]),
        jnp.stack([jnp.zeros(2), velocity]),
        jnp.array([[0], [1]]),
        DT,
        0.07,
        half_size=jnp.array([[0.05, 0.1], [0.0, 0.0]]),
    )
    return found.time_of_impact[0], found.normal[0]


def test_a_body_meets_the_side_it_comes_to_and_slides_along() -> None:
    """A ball of 2 cm before the long side of a box of 10 by 20 cm: its centre touches at 7 cm."""
    met = jax.jit(_met)
    time, normal = met(np.array([0.08, 0.06]), np.array([-0.5, 0.4]))
    np.testing.assert_allclose(time, 0.01 / 0.5 / DT, rtol=1e-5)
    np.testing.assert_allclose(normal, [1.0, 0.0], atol=1e-6)
    # Round bodies of the same contact distance would be 3 cm apart there.
    beside, _ = met(np.array([0.08, 0.06]), np.array([0.0, -0.5]))
    assert beside == 0.0
    check_grads(lambda *moved: met(*moved)[0], (np.array([0.08, 0.06]), np.array([-0.5, 0.4])), 1)
