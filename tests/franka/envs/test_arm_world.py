"""The grasp: closing of the fingers, friction, and measured contact."""

import mujoco
import numpy as np
import pytest
from franka_runs import WatchedTask, pads_touching, push, step_once, world_with_hand_at

from contactgraph.envs.episodes import run_episode
from contactgraph_franka.envs.arm_world import (
    HALF_BLOCK,
    LAG,
    MISS,
    OPEN,
    REACH,
    SPEED,
    GraspReflex,
)
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.franka_task import FrankaTask
from contactgraph_franka.envs.pickup import Grasp

BOTH = {"left_pad", "right_pad"}
BLOCK = (0.5, 0.1, 0.05)
YAW = 0.9


def closed_on_block(grasp=Grasp.FRICTION):
    """A world whose fingers have closed on the block between them."""
    world = world_with_hand_at(BLOCK, YAW, BLOCK, YAW, grasp)
    for _ in range(50):
        world.step(push([0.0, 0.0, 0.0]))
    assert pads_touching(world) == BOTH
    return world


def in_hand(world):
    """[3] m and [3, 3]: the block's place and orientation in the hand's frame."""
    hand, block = world.data.body("hand"), world.data.body("block0")
    frame = hand.xmat.reshape(3, 3)
    return frame.T @ (block.xpos - hand.xpos), frame.T @ block.xmat.reshape(3, 3)


def test_a_block_is_grasped_by_friction_alone():
    world = closed_on_block()
    place, turned = in_hand(world)
    for _ in range(30):
        world.step(push([3.0, 0.0, 8.0]))
    assert world.position[1, 2] > 0.08
    moved, rolled = in_hand(world)
    np.testing.assert_allclose(moved, place, atol=5e-3)
    np.testing.assert_allclose(rolled, turned, atol=0.05)
    welds = world.model.eq_type == mujoco.mjtEq.mjEQ_WELD
    assert welds.any() and not world.data.eq_active[welds].any()


def test_a_block_falls_as_the_fingers_open():
    world = closed_on_block()
    for _ in range(25):
        world.step(push([0.0, 0.0, 8.0]))
    lifted, hand = world.position[1, 2], world.position[0, 2]
    assert lifted > 0.07
    for _ in range(400):
        step_once(world, [0.0, 0.0, 0.0], fingers=0.04)
    assert not pads_touching(world)
    assert world.position[1, 2] < 0.06 < hand < world.position[0, 2]


def test_a_weld_keeps_the_pose_of_the_grasp():
    world = closed_on_block(Grasp.WELD)
    place, turned = in_hand(world)
    weld = world.model.equality("weld0").id
    assert world.data.eq_active[weld]
    tie = world.model.eq_data[weld].copy()
    for _ in range(30):
        world.step(push([6.0, -4.0, 10.0]))
    moved, rolled = in_hand(world)
    np.testing.assert_allclose(moved, place, atol=5e-4)
    np.testing.assert_allclose(rolled, turned, atol=5e-3)
    for _ in range(300):
        step_once(world, [0.0, 0.0, 0.0], fingers=0.04)
    np.testing.assert_allclose(in_hand(world)[0], place, atol=1e-3)
    np.testing.assert_array_equal(world.model.eq_data[weld], tie)


def test_the_hand_with_its_load_is_a_mass_of_both():
    world = closed_on_block(Grasp.WELD)
    force, load = np.array([1.0, -2.0, 9.0]), 0.4
    world.step(push(force))
    world.step(push(force))
    before = world.velocity[0]
    for _ in range(20):
        world.step(push(force))
    gained = (world.velocity[0] - before) / 0.2
    wanted = (force - [0.0, 0.0, load * 9.81]) / (4.0 + load)
    np.testing.assert_allclose(gained, wanted, rtol=0.05, atol=0.03)
    assert np.degrees(np.linalg.norm(world.impedance.turn)) < 1.0


@pytest.mark.parametrize(
    "grasp", [Grasp.FRICTION, pytest.param(Grasp.WELD, marks=pytest.mark.slow)]
)
def test_contact_is_that_of_the_pads(grasp):
    task = WatchedTask(1, grasp)
    run = run_episode(task, FrankaExpert(), 4)
    touching = [bool(pads_touching(task.world, pairs)) for pairs in task.watched.contacts]
    touched = np.reshape(touching, (400, 10)).any(axis=1).tolist()
    assert run.contact[1:, 0, 1].tolist() == touched
    assert not run.contact[:, :, 2].any() and not run.contact[0].any()
    # Once there it stays: the fingers do not bounce.
    first = touched.index(True)
    assert 20 < first < 300 and all(touched[first:])


def test_blocks_that_touch_are_measured_too():
    task = FrankaTask(2)
    task.reset(seed=1)
    data = task.world.data
    data.qpos[9 + 14 : 9 + 17] = data.qpos[9 + 7 : 9 + 10] + np.array([0.0, 0.0, 0.0999])
    mujoco.mj_forward(task.world.model, data)
    contact = task.world.contact
    assert contact[2, 3] and contact[3, 2] and contact.sum() == 2


def approach(speed, aside=0.0, start=0.2, dt=0.001):
    """Distances along the way and where the fingers are sent, as the hand passes a block."""
    reflex, distance, record = GraspReflex(), start, []
    while distance > -start:
        offset, velocity = np.array([[distance, aside, 0.0]]), np.array([[speed, 0.0, 0.0]])
        record.append((distance, reflex.step(offset, velocity, False, dt)))
        distance -= speed * dt
    return np.array(record)


@pytest.mark.parametrize("speed", [0.1, 0.3, 0.6])
def test_the_fingers_are_at_the_block_as_the_hand_is(speed):
    record = approach(speed)
    distance, way = record.T
    closed = distance[way <= HALF_BLOCK + 1e-6][0]
    assert closed == pytest.approx(REACH + LAG * speed, abs=2e-3 * speed + SPEED * 1e-3)
    assert np.diff(way).min() >= -SPEED * 1e-3 - 1e-12
    assert np.all(way[distance > REACH + (LAG + 0.21) * speed] == OPEN)


def test_the_fingers_ignore_a_block_that_passes_by_or_moves_away():
    for aside in (MISS + 1e-3, -0.1):
        assert np.all(approach(0.3, aside)[:, 1] == OPEN)
    away = GraspReflex()
    for _ in range(100):
        way = away.step(np.array([[0.05, 0.0, 0.0]]), np.array([[-0.3, 0.0, 0.0]]), False, 0.001)
        assert way == OPEN


def test_the_fingers_press_on_a_grasped_block_and_open_when_it_is_lost():
    reflex = GraspReflex()
    still = np.zeros((1, 3))
    assert reflex.step(np.array([[0.0, 0.0, 0.0]]), still, True, 0.001) == 0.0
    assert reflex.step(np.array([[0.02, 0.0, 0.0]]), still, False, 0.001) == 0.0
    assert reflex.step(np.array([[0.031, 0.0, 0.0]]), still, False, 0.001) == OPEN


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_block_that_is_met_first_decides(order):
    blocks, velocity = np.array([[0.05, 0.0, 0.0], [0.4, 0.0, 0.0]]), np.full((2, 3), [0.3, 0, 0])
    alone, far = (GraspReflex().step(b[None], velocity[:1], False, 1.0) for b in blocks)
    both = GraspReflex().step(blocks[order], velocity, False, 1.0)
    assert both == alone < far == OPEN
