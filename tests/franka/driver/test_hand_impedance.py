"""Impedance control of MuJoCo's arm, with and without motor inertia and friction."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from simulated_arm import SimulatedArm, push

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


@pytest.mark.parametrize("force", FORCES[2:])
@pytest.mark.parametrize("drives", [NO_DRIVES, ROTORS, FR3_DRIVES])
def test_free_hand_is_a_mass_of_four_kilograms(force: list[float], drives: JointDrives) -> None:
    positions, turns = push(
        SimulatedArm(drives), HandImpedance(FR3_LIMITS, drives), np.array(force), 420
    )
    wanted = np.array(force) / MASS
    # Friction is estimated, in joints that move and come to rest.
    close = 0.03 if drives is FR3_DRIVES else 0.01
    assert np.linalg.norm(acceleration(positions) - wanted) < close * np.linalg.norm(wanted)
    assert np.degrees(np.abs(turns).max()) < 0.2


@pytest.mark.parametrize("drives", [NO_DRIVES, FR3_DRIVES])
def test_torques_three_cycles_late(drives: JointDrives) -> None:
    arm = SimulatedArm(drives, delay=3)
    force = np.array(FORCES[3])
    positions, turns = push(arm, HandImpedance(FR3_LIMITS, drives), force, 420)
    assert np.linalg.norm(acceleration(positions) - force / MASS) < 0.05
    assert np.degrees(np.abs(turns).max()) < 0.2


def test_noisy_velocities() -> None:
    random = np.random.default_rng(0)
    arm, impedance = SimulatedArm(NO_DRIVES, delay=2), HandImpedance(FR3_LIMITS, NO_DRIVES)
    impedance.hold(arm.state())
    force, positions, torques = np.array([0.0, 4.0, 0.0]), [], []
    for _ in range(420):
        state = arm.state()
        state.joint_velocity = state.joint_velocity + 1e-3 * random.standard_normal(JOINTS)
        torques.append(impedance(force, state).torque)
        arm.step(torques[-1])
        positions.append(arm.position)
    np.testing.assert_allclose(acceleration(np.array(positions)), force / MASS, atol=0.02)
    assert np.diff(torques, axis=0)[100:].std(axis=0).max() < 0.7


def test_compensating_absent_friction_accelerates_the_hand() -> None:
    """The reason for the warning of `FR3_DRIVES`."""
    force = np.array([0.0, 0.5, 0.0])
    positions, _ = push(SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, FR3_DRIVES), force, 420)
    assert np.linalg.norm(acceleration(positions)) > 3.0 * force[1] / MASS


def test_unmodelled_drives_slow_the_hand() -> None:
    positions, _ = push(
        SimulatedArm(FR3_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES), np.array(FORCES[0]), 420
    )
    assert acceleration(positions)[0] < 0.9 * FORCES[0][0] / MASS


def test_hand_without_force_stays() -> None:
    positions, _ = push(
        SimulatedArm(FR3_DRIVES), HandImpedance(FR3_LIMITS, FR3_DRIVES), np.zeros(3), 600
    )
    assert np.abs(positions - positions[0]).max() < 1e-4


@pytest.mark.parametrize("drives", [NO_DRIVES, FR3_DRIVES])
def test_hand_yields_to_a_load(drives: JointDrives) -> None:
    load = 0.83
    force = np.array([0.0, 0.0, 14.0])
    positions, turns = push(
        SimulatedArm(drives, load), HandImpedance(FR3_LIMITS, drives), force, 420
    )
    wanted = (force - [0.0, 0.0, load * 9.81]) / (MASS + load)
    assert np.linalg.norm(acceleration(positions) - wanted) < 0.05 * np.linalg.norm(wanted)
    assert np.degrees(np.abs(turns).max()) < 0.5


def test_orientation_is_restored() -> None:
    arm, impedance = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    impedance.hold(arm.state())
    arm.data.qpos[6] += 0.05
    arm.refresh()
    assert np.linalg.norm(impedance.turn(arm.state())) == pytest.approx(0.05, rel=1e-6)
    for _ in range(2000):
        arm.step(impedance(np.zeros(3), arm.state()).torque)
    assert np.degrees(np.linalg.norm(impedance.turn(arm.state()))) < 0.2


def test_torque_limit_shortens_the_force_in_its_direction() -> None:
    arm = SimulatedArm(NO_DRIVES)
    low = np.minimum(FR3_LIMITS.torque, 2.0)
    weak = JointLimits(FR3_LIMITS.low, FR3_LIMITS.high, low, torque_rate=1e6)
    impedance = HandImpedance(weak, NO_DRIVES)
    impedance.hold(arm.state())
    requested = np.array([12.0, -9.0, 6.0])
    command = impedance(requested, arm.state())
    assert np.abs(command.torque).max() == pytest.approx(2.0)
    share = np.linalg.norm(command.force) / np.linalg.norm(requested)
    assert 0.05 < share < 0.9
    np.testing.assert_allclose(command.force, share * requested, rtol=1e-9)


def test_torque_rate_limit() -> None:
    arm, impedance = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    impedance.hold(arm.state())
    last, requested = np.zeros(JOINTS), np.array([15.0, 10.0, -5.0])
    for cycle in range(30):
        command = impedance(requested, arm.state())
        assert np.abs(command.torque - last).max() <= 1.0 + 1e-9
        if cycle == 0:
            share = np.linalg.norm(command.force) / np.linalg.norm(requested)
            assert 0.05 < share < 0.5
            np.testing.assert_allclose(command.force, share * requested, rtol=1e-9)
        last = command.torque
        arm.step(command.torque)
    np.testing.assert_allclose(command.force, requested, rtol=1e-6)


def test_missed_cycles_count_for_the_rate_limit() -> None:
    arm, impedance = SimulatedArm(NO_DRIVES), HandImpedance(FR3_LIMITS, NO_DRIVES)
    state = arm.state()
    impedance.hold(state)
    state.time += 0.003
    assert np.abs(impedance(np.array([15.0, 10.0, -5.0]), state).torque).max() == pytest.approx(3.0)


def test_repeated_state_changes_no_estimate() -> None:
    arm, impedance = SimulatedArm(NO_DRIVES, load=0.5), HandImpedance(FR3_LIMITS, NO_DRIVES)
    impedance.hold(arm.state())
    for _ in range(20):
        state = arm.state()
        arm.step(impedance(np.zeros(3), state).torque)
    before = impedance.load.copy()
    impedance(np.zeros(3), state)
    np.testing.assert_array_equal(impedance.load, before)
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
    # In the base's frame, also for a hand that points down; and the shorter rotation.
    down = (1.0, 0.0, 0.0, 0.0)
    turned = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    np.testing.assert_allclose(rotation_between(down, turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(rotation_between(down, -turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_array_equal(rotation_between(down, np.array(down)), np.zeros(3))


def test_invalid_mass() -> None:
    with pytest.raises(InvalidInputError, match="mass must be a positive number, found 0"):
        HandImpedance(FR3_LIMITS, NO_DRIVES, mass=0.0)
