"""The simulated arm's physics, stepped without a server."""

from collections.abc import Iterator

import numpy as np
import pytest

from contactgraph.data import InvalidInputError

pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")

from contactgraph_franka.sim.arm_server import CONTROL_PERIOD, ArmScene, StateRecorder
from contactgraph_franka.sim.shared_state import ground_truth_fields

DOWN = (1.0, 0.0, 0.0, 0.0)
"""The hand's quaternion (x, y, z, w), pointing down."""
TO_TCP = np.array([0.0, 0.0, 0.022])
"""m: franky-sim's own point of the hand is that far above the grasp point."""


@pytest.fixture
def scene() -> Iterator[ArmScene]:
    with ArmScene(blocks=1) as scene:
        scene.start()
        yield scene


def observed(scene: ArmScene) -> np.void:
    fields = ground_truth_fields(len(scene.blocks), scene.model.nq)
    row = np.zeros(1, np.dtype(fields))[0]
    StateRecorder(scene).fill(row, 0, 0.0)
    return row


def hold(scene: ArmScene, point: np.ndarray) -> None:
    scene.robot.cartesian_position_control([*(point + TO_TCP), *DOWN], None)
    scene.step()


def go(scene: ArmScene, start: np.ndarray, end: np.ndarray, seconds: float) -> None:
    for part in np.linspace(0.0, 1.0, round(seconds / CONTROL_PERIOD)):
        hold(scene, start + (end - start) * (10 * part**3 - 15 * part**4 + 6 * part**5))


def test_torques_meet_the_links_inertia_and_nothing_else(scene: ArmScene) -> None:
    # Joint 7 turns the hand about an axis through its fingers: 0.05 N m against its inertia.
    import mujoco

    inertia = np.zeros((scene.model.nv, scene.model.nv))
    for row, unit in zip(inertia, np.eye(len(inertia)), strict=True):  # it is symmetric
        mujoco.mj_mulM(scene.model, scene.data, row, unit)
    torque = np.array([1.0, -2.0, 0.5, 1.0, 0.1, 0.1, 0.005])
    expected = np.linalg.solve(inertia[:9, :9], [*torque, 0.0, 0.0])[:7]
    scene.robot.torque_control(torque)
    scene.step()
    np.testing.assert_allclose(scene.data.qvel[:7] / CONTROL_PERIOD, expected, rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_a_grasped_block_stays_in_hand_under_3_m_s2(scene: ArmScene) -> None:
    at = np.array([0.45, 0.0, 0.05])
    scene.place_block(0, at, 0.0)
    scene.robot.set_hand_goal(0.08, 0.05, 70.0)
    go(scene, np.array([0.45, 0.0, 0.3]), at, 1.5)
    assert not observed(scene)["fingers"].any()
    scene.robot.set_hand_goal(0.0, 0.05, 40.0)
    for _ in range(600):
        hold(scene, at)
    grasped = observed(scene)
    assert grasped["fingers"].all() and grasped["width"] == pytest.approx(0.04, abs=2e-4)
    offset = grasped["position"][1] - grasped["position"][0]
    hardest = 0.0
    for direction in ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]):
        begin, velocity = at, scene.data.qvel[9:12].copy()
        for cycle in range(500):
            time = min(cycle * CONTROL_PERIOD, 0.3)
            # Half of the time 3 m/s^2, the other half as much backwards.
            way = 1.5 * time**2 if time < 0.15 else 0.0675 - 1.5 * (0.3 - time) ** 2
            at = begin + way * np.array(direction)
            hold(scene, at)
            if cycle % 20 == 19:
                change = np.linalg.norm(scene.data.qvel[9:12] - velocity)
                hardest = max(hardest, float(change) / 0.02)
                velocity = scene.data.qvel[9:12].copy()
    lifted = observed(scene)
    assert hardest > 3.0
    assert lifted["fingers"].all() and not lifted["standing"][0]
    assert np.linalg.norm(lifted["position"][1] - lifted["position"][0] - offset) < 5e-4


def test_a_placed_block_is_at_rest_and_an_arm_without_torques_floats(scene: ArmScene) -> None:
    hand = observed(scene)["position"][0].copy()
    scene.data.qvel[9:15] = 1.0
    scene.place_block(0, np.array([0.6, 0.2, 0.05]), 0.5)
    for _ in range(300):
        scene.robot.torque_control(np.zeros(7))
        scene.step()
    row = observed(scene)
    np.testing.assert_allclose(row["position"][1], [0.6, 0.2, 0.05], atol=2e-4)
    np.testing.assert_allclose(row["turn"][1], [np.cos(0.25), 0, 0, np.sin(0.25)], atol=1e-3)
    assert np.abs(row["velocity"][1]).max() < 1e-3
    assert row["standing"][0] and not row["fingers"].any()
    np.testing.assert_allclose(row["position"][0], hand, atol=1e-3)


def test_blocks_without_tags_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"blocks must be 0 to 2, found 3"):
        ArmScene(blocks=3)
