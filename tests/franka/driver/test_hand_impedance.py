"""The law against MuJoCo's arm: what the hand feels like, with and without drives of its own."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from simulated_arm import SimulatedArm, pushed

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import (
    FR3_DRIVES,
    FR3_LIMITS,
    JOINTS,
    NO_DRIVES,
    JointDrives,
    JointLimits,
)
from contactgraph_franka.driver.impedance import HandImpedance, bias_acceleration, rotation_between

MASS = 4.0
FORCES = [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0], [-2.0, 3.0, -2.0]]
ROTORS = JointDrives(FR3_DRIVES.inertia, np.zeros(JOINTS), FR3_DRIVES.damping)


def acceleration(positions: np.ndarray) -> np.ndarray:
    """[3] m/s^2, mean from 0.1 to 0.4 s."""
    velocity = np.gradient(positions, 0.001, axis=0)
    return (velocity[400] - velocity[100]) / 0.3


@pytest.mark.parametrize("force", FORCES)
@pytest.mark.parametrize("drives", [NO_DRIVES, ROTORS, FR3_DRIVES])
def test_a_free_hand_is_a_mass_of_four_kilograms(force: list[float], drives: JointDrives) -> None:
    positions, turns = pushed(
        SimulatedArm(drives), HandImpedance(FR3_LIMITS, drives), np.array(force), 420
    )
    wanted = np.array(force) / MASS
    # Friction is estimated, in joints that turn and come to rest on the way.
    close = 0.03 if drives is FR3_DRIVES else 0.01
    assert np.linalg.norm(acceleration(positions) - wanted) < close * np.linalg.norm(wanted)
    assert np.degrees(np.abs(turns).max()) < 0.2


@pytest.mark.parametrize("drives", [NO_DRIVES, FR3_DRIVES])
def test_torques_that_come_three_ticks_late(drives: JointDrives) -> None:
    arm = SimulatedArm(drives, delay=3)
    force = np.array(FORCES[3])
    positions, turns = pushed(arm, HandImpedance(FR3_LIMITS, drives), force, 420)
    assert np.linalg.norm(acceleration(positions) - force / MASS) < 0.05
    assert np.degrees(np.abs(turns).max()) < 0.2


def test_noisy_velocities_shake_the_hand_but_do_not_lead_it_astray() -> None:
    random = np.random.default_rng(0)
    arm, law = SimulatedArm(NO_DRIVES, delay=2), HandImpedance(FR3_LIMITS, NO_DRIVES)
    law.hold(arm.state())
    force, positions, torques = np.array([0.0, 4.0, 0.0]), [], []
    for _ in range(420):
        state = arm.state()
        state.joint_velocity = state.joint_velocity + 1e-3 * random.standard_normal(JOINTS)
        torques.append(law(force, state).torque)
        arm.step(torques[-1])
        positions.append(arm.position)
    np.testing.assert_allclose(acceleration(np.array(positions)), force / MASS, atol=0.02)
    assert np.diff(torques, axis=0)[100:].std(axis=0).max() < 0.7


def test_friction_that_is_not_there_pushes_the_hand_on() -> None:
    """Why an arm's drives are not to be guessed: the test holds what `FR3_DRIVES` warns of."""
    force = np.array([0.0, 0.5, 0.0])
    positions, _ = pushed(
        SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, FR3_DRIVES), force, 420
    )
    assert np.linalg.norm(acceleration(positions)) > 3.0 * force[1] / MASS


def test_drives_that_nobody_told_the_law_of_are_felt() -> None:
    positions, _ = pushed(
        SimulatedArm(FR3_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES), np.array(FORCES[0]), 420
    )
    assert acceleration(positions)[0] < 0.9 * FORCES[0][0] / MASS


def test_a_hand_that_nobody_pushes_stays() -> None:
    positions, _ = pushed(
        SimulatedArm(FR3_DRIVES), HandImpedance(FR3_LIMITS, FR3_DRIVES), np.zeros(3), 1000
    )
    assert np.abs(positions - positions[0]).max() < 1e-4


@pytest.mark.parametrize("drives", [NO_DRIVES, FR3_DRIVES])
def test_a_load_is_felt(drives: JointDrives) -> None:
    load = 0.83
    force = np.array([0.0, 0.0, 14.0])
    positions, turns = pushed(
        SimulatedArm(drives, load), HandImpedance(FR3_LIMITS, drives), force, 420
    )
    wanted = (force - [0.0, 0.0, load * 9.81]) / (MASS + load)
    assert np.linalg.norm(acceleration(positions) - wanted) < 0.05 * np.linalg.norm(wanted)
    assert np.degrees(np.abs(turns).max()) < 0.5


def test_a_turned_hand_turns_back() -> None:
    arm, law = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    law.hold(arm.state())
    arm.data.qpos[6] += 0.05
    arm.refresh()
    assert np.linalg.norm(law.turn(arm.state())) == pytest.approx(0.05, rel=1e-6)
    for _ in range(2000):
        arm.step(law(np.zeros(3), arm.state()).torque)
    assert np.degrees(np.linalg.norm(law.turn(arm.state()))) < 0.2


def test_a_limit_shortens_the_force_and_keeps_its_direction() -> None:
    arm = SimulatedArm(NO_DRIVES)
    low = np.minimum(FR3_LIMITS.torque, 2.0)
    weak = JointLimits(FR3_LIMITS.low, FR3_LIMITS.high, low, torque_rate=1e6)
    law = HandImpedance(weak, NO_DRIVES)
    law.hold(arm.state())
    asked = np.array([12.0, -9.0, 6.0])
    told = law(asked, arm.state())
    assert np.abs(told.torque).max() == pytest.approx(2.0)
    share = np.linalg.norm(told.force) / np.linalg.norm(asked)
    assert 0.05 < share < 0.9
    np.testing.assert_allclose(told.force, share * asked, rtol=1e-9)


def test_torques_change_no_faster_than_allowed() -> None:
    arm, law = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    law.hold(arm.state())
    last, asked = np.zeros(JOINTS), np.array([15.0, 10.0, -5.0])
    for tick in range(30):
        told = law(asked, arm.state())
        assert np.abs(told.torque - last).max() <= 1.0 + 1e-9
        if tick == 0:
            share = np.linalg.norm(told.force) / np.linalg.norm(asked)
            assert 0.05 < share < 0.5
            np.testing.assert_allclose(told.force, share * asked, rtol=1e-9)
        last = told.torque
        arm.step(told.torque)
    np.testing.assert_allclose(told.force, asked, rtol=1e-6)


def test_what_was_missed_may_be_made_up_for() -> None:
    arm, law = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    state = arm.state()
    law.hold(state)
    state.time += 0.003
    assert np.abs(law(np.array([15.0, 10.0, -5.0]), state).torque).max() == pytest.approx(3.0)


def test_the_same_state_told_twice_changes_no_estimate() -> None:
    arm, law = SimulatedArm(NO_DRIVES, load=0.5), HandImpedance(FR3_LIMITS, NO_DRIVES)
    law.hold(arm.state())
    for _ in range(20):
        state = arm.state()
        arm.step(law(np.zeros(3), state).torque)
    before = law.load.copy()
    law(np.zeros(3), state)
    np.testing.assert_array_equal(law.load, before)
    assert np.abs(before).max() > 1.0


def test_bias_acceleration_against_finite_differences() -> None:
    arm = SimulatedArm(NO_DRIVES)
    velocity = np.array([0.5, -0.3, 0.8, 0.2, -0.6, 0.4, 1.0])
    here = arm.state().jacobian
    step = 1e-6
    arm.data.qpos[:JOINTS] += step * velocity
    arm.refresh()
    expected = (arm.state().jacobian - here) @ velocity / step
    np.testing.assert_allclose(bias_acceleration(here, velocity), expected, atol=1e-5)


def test_rotations_between() -> None:
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        rotation_between((0.0, 0.0, 0.0, 1.0), np.array([0.0, 0.0, half, half])),
        [0.0, 0.0, np.pi / 2],
    )
    # In the base's frame, also where the hand points down; and the short way round.
    down = (1.0, 0.0, 0.0, 0.0)
    turned = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    np.testing.assert_allclose(rotation_between(down, turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(rotation_between(down, -turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_array_equal(rotation_between(down, np.array(down)), np.zeros(3))


def test_a_mass_that_is_none() -> None:
    with pytest.raises(InvalidInputError, match="mass must be a positive number, found 0"):
        HandImpedance(FR3_LIMITS, NO_DRIVES, mass=0.0)
