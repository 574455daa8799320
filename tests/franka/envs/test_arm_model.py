"""The arm's kinematics, response to forces, and limits."""

import mujoco
import numpy as np
import pytest
from franka_runs import HIGH, LOW, TORQUE, Watched, push, step_once, world_with_hand_at

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.arm_model import inverse_kinematics
from contactgraph_franka.envs.franka_task import FrankaTask
from contactgraph_franka.envs.pickup import sample_layout

POINTS = [(0.45, 0.0, 0.25), (0.35, -0.3, 0.2), (0.65, 0.3, 0.1)]
MAKERS_TABLE = [
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
]
"""a m, d m, alpha rad of each joint, by Denavit and Hartenberg as Craig has them."""
FLANGE = 0.107


@pytest.fixture(scope="module")
def arm():
    return FrankaTask().begin(0)[1].model


def frames_by_table(joints):
    """[8, 4, 4]: of every link, and of the flange."""
    frame, frames = np.eye(4), []
    for (a, d, alpha), angle in zip(MAKERS_TABLE, joints, strict=True):
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        frame = frame @ [
            [ct, -st, 0.0, a],
            [st * ca, ct * ca, -sa, -d * sa],
            [st * sa, ct * sa, ca, d * ca],
            [0.0, 0.0, 0.0, 1.0],
        ]
        frames.append(frame)
    flange = np.eye(4)
    flange[2, 3] = FLANGE
    return np.stack([*frames, frame @ flange])


def test_forward_kinematics_agree_with_the_makers_table(arm):
    data = mujoco.MjData(arm)
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = rng.uniform(LOW, HIGH)
        data.qpos[:7] = joints
        mujoco.mj_kinematics(arm, data)
        wanted = frames_by_table(joints)
        for index in range(7):
            link = data.body(f"link{index + 1}")
            np.testing.assert_allclose(link.xpos, wanted[index, :3, 3], atol=1e-9)
            np.testing.assert_allclose(link.xmat.reshape(3, 3), wanted[index, :3, :3], atol=1e-9)
        # The hand is mounted on the flange, an eighth of a turn back.
        np.testing.assert_allclose(data.body("hand").xpos, wanted[7, :3, 3], atol=1e-9)
        turned = wanted[7, :3, :3].T @ data.body("hand").xmat.reshape(3, 3)
        half = np.sqrt(0.5)
        eighth = [[half, half, 0.0], [-half, half, 0.0], [0.0, 0.0, 1.0]]
        np.testing.assert_allclose(turned, eighth, atol=1e-6)


def test_limits_are_the_makers(arm):
    np.testing.assert_array_equal(arm.jnt_range[:7], np.stack([LOW, HIGH], axis=1))
    np.testing.assert_array_equal(arm.jnt_actfrcrange[:7, 1], TORQUE)


def test_inverse_kinematics_reach_every_start(arm):
    data = mujoco.MjData(arm)
    for seed in range(40):
        layout = sample_layout(np.random.default_rng(seed), 0)
        joints = inverse_kinematics(arm, layout.hand, layout.yaw)
        assert np.all((joints > LOW) & (joints < HIGH))
        data.qpos[:7] = joints
        mujoco.mj_kinematics(arm, data)
        site = data.site("grasp")
        np.testing.assert_allclose(site.xpos, layout.hand, atol=1e-4)
        cos, sin = np.cos(layout.yaw), np.sin(layout.yaw)
        wanted = [[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]]
        np.testing.assert_allclose(site.xmat.reshape(3, 3), wanted, atol=1e-4)


@pytest.mark.parametrize("point", [(1.1, 0.0, 0.2), (0.05, 0.0, 0.1), (0.6, 0.0, 0.9)])
def test_unreachable_points_are_refused(arm, point):
    with pytest.raises(InvalidInputError) as refused:
        inverse_kinematics(arm, np.array(point), 0.0)
    assert str(refused.value) == (
        f"the hand cannot be at {list(point)} m; it reaches x 0.3 to 0.7, y -0.35 to 0.35, "
        "z 0.05 to 0.35"
    )


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("axis", range(3))
def test_the_free_hand_is_a_mass_of_4_kg_on_every_axis(point, axis):
    world = world_with_hand_at(point)
    force = np.eye(3)[axis] * 6.0
    for _ in range(20):
        world.step(push(force))
    np.testing.assert_allclose(world.velocity[0], 0.2 * force / 4.0, rtol=0.01, atol=2e-3)
    np.testing.assert_allclose(
        world.position[0], point + 0.5 * 0.2**2 * force / 4.0, rtol=1e-3, atol=2e-4
    )


def test_a_force_from_outside_moves_the_hand_as_the_control_does():
    world = world_with_hand_at(POINTS[0])
    hand = world.model.body("hand").id
    outer, force = np.array([2.0, -5.0, -3.0]), np.array([1.0, 2.0, 4.0])
    world.data.xfrc_applied[hand, :3] = outer
    # At the grasp point: a force at the hand's centre of mass, and its moment.
    offset = world.position[0] - world.data.xipos[hand]
    world.data.xfrc_applied[hand, 3:] = np.cross(offset, outer)
    world.step(push(force))  # the observer takes a few ms to see it
    before = world.velocity[0]
    for _ in range(20):
        world.step(push(force))
    gained = (world.velocity[0] - before) / 0.2
    np.testing.assert_allclose(gained, (outer + force) / 4.0, rtol=0.05, atol=0.03)
    assert np.degrees(np.linalg.norm(world.impedance.turn)) < 1.0


def elbow_aside(world, angle):
    """Turns the elbow about the line from shoulder to wrist, the hand where it was."""
    model, data, jacobian = world.model, world.data, np.zeros((6, world.model.nv))
    site = model.site("grasp").id
    start, steps = world.position[0], 200
    way = None
    for _ in range(steps):
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        free = np.linalg.svd(jacobian[:, :7])[2][-1]
        way = free if way is None else free * np.sign(free @ way)
        miss = np.concatenate([start - world.position[0], -world.impedance.turn])
        data.qpos[:7] += angle / steps * way + np.linalg.pinv(jacobian[:, :7]) @ miss
        mujoco.mj_step1(model, data)


def test_the_elbow_moves_home_without_the_hand():
    world = world_with_hand_at(POINTS[0])
    home = world.data.qpos[:7].copy()
    elbow_aside(world, 0.4)
    assert np.abs(world.data.qpos[:7] - home).max() > 0.15
    start = world.position[0]
    for _ in range(1500):
        step_once(world, [0.0, 0.0, 0.0])
        np.testing.assert_allclose(world.position[0], start, atol=5e-4)
    assert np.abs(world.data.qpos[:7] - home).max() < 0.05
    assert np.degrees(np.linalg.norm(world.impedance.turn)) < 0.2


@pytest.mark.parametrize(
    "force", [(20, 0, 0), (-20, 0, 0), (0, 20, 0), (0, 0, 20), (0, 0, -20), (-20, -20, 20)]
)
def test_the_largest_forces_bring_the_arm_to_a_stop_within_its_limits(force):
    world = world_with_hand_at(POINTS[0])
    watched = world.impedance = Watched(world)
    while not world.brakes.closed:
        world.step(push(force))
        assert len(watched.torque) < 2000
    for _ in range(20):
        world.step(push(force))
    assert np.all(np.abs(watched.torque) <= TORQUE + 1e-9)
    joints = np.array(watched.joints)
    assert np.all((joints > LOW - 0.03) & (joints < HIGH + 0.03))
    assert max(watched.turn_angle) < 5.0
    assert np.linalg.norm(world.velocity[0]) < 0.02


def test_no_torque_above_the_limit_is_requested():
    world = world_with_hand_at(POINTS[0])
    torque = world.impedance(np.array([900.0, 2000.0, 5000.0]))
    assert np.all(np.abs(torque) <= TORQUE) and np.any(np.abs(torque) == TORQUE)


def test_forces_at_the_bounds_within_the_scene_keep_the_orientation():
    rng = np.random.default_rng(3)
    world = world_with_hand_at(POINTS[0])
    watched = world.impedance = Watched(world)
    for _ in range(20):
        force = rng.choice([-20.0, 20.0], 3)
        for sign in (1.0, -1.0, -1.0, 1.0):
            for _ in range(6):
                world.step(push(sign * force))
    assert not world.brakes.closed
    assert max(watched.turn_angle) < 0.5
