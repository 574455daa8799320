"""Bodies that turn in space: features against MuJoCo, levers, turns that do not add up, steps."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.data import Scene
from contactgraph.data.trajectory_batch import pad_nodes
from contactgraph.data.turns import quaternions
from contactgraph.model.polygons import contact_points
from contactgraph.model.rotations import placed

pytestmark = pytest.mark.usefixtures("double_precision")

DT, LENGTH = 0.02, 0.05
HALF = np.array([0.05, 0.03, 0.02])
SIGNS = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
BOX = HALF * SIGNS
EDGE = jnp.array([[0], [1]])


def scene(shapes: list[np.ndarray | None], **options) -> Scene:
    known = [node for node, each in enumerate(shapes) if each is not None]
    return Scene(
        node_name=tuple(f"body-{node}" for node in range(len(shapes))),
        node_type=tuple("ball" if each is None else "box" for each in shapes),
        actuated=np.zeros(len(shapes), bool),
        dt=DT,
        dimension=3,
        polygons=tuple(shapes[node] for node in known),
        polygon_of=np.array(known),
        **options,
    )


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def nearest(shapes, position):
    return contact_points(placed(shapes, position, 1.0), EDGE, LENGTH)


def drawn(count: int, reach: float, seed: int = 0) -> np.ndarray:
    """[count, 2, 6] m and rad"""
    rng = np.random.default_rng(seed)
    position = np.zeros((count, 2, 6))
    position[:, 1, :3] = rng.uniform(-reach, reach, (count, 3))
    position[:, :, 3:] = Rotation.random(2 * count, rng).as_rotvec().reshape(count, 2, 3)
    return position


def mujoco_distances(kind: str, size: str, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances, and points of both, of a box from another body."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body mocap="true"><geom type="box" size="0.05 0.03 0.02"/></body>'
        f'<body mocap="true"><geom type="{kind}" size="{size}"/></body></worldbody></mujoco>'
    )
    data, found, ends = mujoco.MjData(model), [], []
    for state in position:
        data.mocap_pos[:] = state[:, :3]
        data.mocap_quat[:] = quaternions(state[:, 3:])
        mujoco.mj_kinematics(model, data)
        between = np.zeros(6)
        found.append(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, between))
        ends.append(between.reshape(2, 3))
    return np.array(found), np.array(ends)


def test_a_box_and_a_ball_are_as_far_apart_as_mujoco_says() -> None:
    position = drawn(2000, 0.1)
    outlines = pad_nodes(scene([BOX, None]), 2).outlines
    points = nearest(outlines, position)
    gap = np.asarray(points.gap)[:, 0, 0] - 0.01
    expected, ends = mujoco_distances("sphere", "0.01", position)
    apart = expected > 0.0
    assert 0.5 < apart.mean() < 0.95
    np.testing.assert_allclose(gap[apart], expected[apart], rtol=2e-4, atol=1e-5)
    np.testing.assert_allclose(np.asarray(points.on_first)[apart, 0, 0], ends[apart, 0], atol=2e-3)
    # A centre inside lies as deep as the nearest face.
    inside = Rotation.from_rotvec(position[:, 0, 3:]).inv().apply(position[:, 1, :3])
    depth = np.max(np.abs(inside) - HALF, axis=1)
    deep = depth < 0.0
    assert deep.sum() > 20
    np.testing.assert_allclose(gap[deep], depth[deep] - 0.01, atol=1e-6)
    assert np.all(np.asarray(points.gap)[:, 0, 1:] > 1.0), "one point, of a ball"


def test_two_boxes_are_as_far_apart_as_mujoco_says() -> None:
    position = drawn(3000, 0.12, seed=1)
    outlines = pad_nodes(scene([BOX, BOX]), 2).outlines
    gap = np.asarray(nearest(outlines, position).gap)[:, 0, 0]
    expected, _ = mujoco_distances("box", "0.05 0.03 0.02", position)
    apart = expected > 1e-4
    assert 0.5 < apart.mean() < 0.95
    np.testing.assert_allclose(gap[apart], expected[apart], rtol=1e-3, atol=2e-4)
    touching = (expected < 0.0) & (expected > -1e-3)
    assert touching.sum() >= 5
    np.testing.assert_allclose(gap[touching], expected[touching], atol=2e-4)
