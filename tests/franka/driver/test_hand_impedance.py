"""Impedance control of MuJoCo's arm, with and without motor inertia and friction."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.arm import (
    FR3_DRIVES,
    FR3_LIMITS,
    JOINTS,
    NO_DRIVES,
    ArmState,
    JointDrives,
    JointLimits,
)
from contactgraph_franka.driver.impedance import HandImpedance, bias_acceleration, rotation_between
from contactgraph_franka.envs.arm_model import mujoco
from contactgraph_franka.envs.arm_world import ArmWorld

POSTURE = np.array([0.1, 0.2, -0.1, -2.2, 0.05, 2.4, 0.7])
"""rad, the hand above the table and pointing down, with no joint at zero."""
POINT = '<site name="grasp" pos="0 0 .1254"/>'
LOAD = '<body pos="0 0 .1254"><inertial pos="0 0 0" mass="{}" diaginertia="1e-4 1e-4 1e-4"/></body>'


class SimulatedArm:
    """The arm with motor inertia and friction; torques act late, as over a network."""

    def __init__(self, drives: JointDrives, load: float = 0.0, delay: int = 1) -> None:
        """``load`` kg at the grasp point is not included in the reported state.

        Torques act ``delay`` cycles late.
        """
        bare = ArmWorld(POSTURE, np.zeros((0, 3)), np.zeros(0), 0.001)
        text = bare.description
        assert POINT in text
        if load:
            text = text.replace(POINT, LOAD.format(load) + POINT)
        self._bare = bare.model
        self._reported, self._still = mujoco.MjData(self._bare), mujoco.MjData(self._bare)
        self._model = mujoco.MjModel.from_xml_string(text)
        self._model.dof_armature[:JOINTS] = drives.inertia
        self._model.dof_frictionloss[:JOINTS] = drives.friction
        self._model.dof_damping[:JOINTS] = drives.damping
        self.data = mujoco.MjData(self._model)
        self.data.qpos[:] = bare.data.qpos
        self._site = self._model.site("grasp").id
        self._sent = [np.zeros(JOINTS)] * (delay + 1)
        self.refresh()

    def state(self) -> ArmState:
        model, data = self._bare, self._reported
        mass, jacobian = np.zeros((model.nv, model.nv)), np.zeros((6, model.nv))
        for column, unit in zip(mass, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._site)
        orientation = np.zeros(4)
        mujoco.mju_mat2Quat(orientation, data.site_xmat[self._site])
        return ArmState(
            time=self.data.time,
            joints=data.qpos[:JOINTS].copy(),
            joint_velocity=data.qvel[:JOINTS].copy(),
            torque=self._sent[0].copy(),
            mass=mass[:JOINTS, :JOINTS],
            coriolis=(data.qfrc_bias - self._still.qfrc_bias)[:JOINTS],
            jacobian=jacobian[:, :JOINTS],
            orientation=np.roll(orientation, -1),
        )

    @property
    def position(self) -> np.ndarray:
        """[3] m, of the grasp point."""
        return self._reported.site_xpos[self._site].copy()

    def step(self, torque: np.ndarray) -> None:
        """One cycle; ``torque`` [7] N m acts in a later one. The arm compensates gravity."""
        self._sent = [*self._sent[1:], torque]
        self.data.ctrl[:JOINTS] = self._sent[0] + self._still.qfrc_bias[:JOINTS]
        mujoco.mj_step(self._model, self.data)
        self.refresh()

    def refresh(self) -> None:
        """Updates the reported state after a change of the joints."""
        self._reported.qpos[:] = self._still.qpos[:] = self.data.qpos
        self._reported.qvel[:] = self.data.qvel
        mujoco.mj_forward(self._bare, self._reported)
        mujoco.mj_forward(self._bare, self._still)


def push(
    arm: SimulatedArm, impedance: HandImpedance, force: np.ndarray, cycles: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T+1, 3] m and turns [T+1, 3] rad of the hand under a force [3] N."""
    impedance.hold(arm.state())
    positions, turns = [arm.position], [np.zeros(3)]
    for _ in range(cycles):
        arm.step(impedance(force, arm.state()).torque)
        positions.append(arm.position)
        turns.append(impedance.turn(arm.state()))
    return np.array(positions), np.array(turns)


MASS = 4.0
UP, ASLANT = np.array([0.0, 0.0, 4.0]), np.array([-2.0, 3.0, -2.0])
ROTORS = JointDrives(FR3_DRIVES.inertia, np.zeros(JOINTS), FR3_DRIVES.damping)


def acceleration(positions: np.ndarray) -> np.ndarray:
    """[3] m/s^2, mean from 0.1 to 0.4 s."""
    velocity = np.gradient(positions, 0.001, axis=0)
    return (velocity[400] - velocity[100]) / 0.3


@pytest.mark.parametrize(
    ("force", "drives", "delay", "close"),
    [
        (UP, NO_DRIVES, 1, 0.01),
        (ASLANT, NO_DRIVES, 1, 0.0103),
        (ASLANT, ROTORS, 1, 0.0103),
        # Friction is estimated, in joints that move and come to rest.
        (UP, FR3_DRIVES, 1, 0.03),
        (ASLANT, FR3_DRIVES, 1, 0.0309),
        (ASLANT, NO_DRIVES, 3, 0.05),
        (ASLANT, FR3_DRIVES, 3, 0.05),
    ],
)
def test_free_hand_is_a_mass_of_four_kilograms(
    force: np.ndarray, drives: JointDrives, delay: int, close: float
) -> None:
    """``close`` m/s^2; torques act ``delay`` cycles late."""
    arm, impedance = SimulatedArm(drives, delay=delay), HandImpedance(FR3_LIMITS, drives)
    positions, turns = push(arm, impedance, force, 420)
    assert np.linalg.norm(acceleration(positions) - force / MASS) < close
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
    # In the base's frame, also for a hand that points down; and the shorter rotation.
    down = (1.0, 0.0, 0.0, 0.0)
    turned = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    np.testing.assert_allclose(rotation_between(down, turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(rotation_between(down, -turned), [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_array_equal(rotation_between(down, np.array(down)), np.zeros(3))


def test_invalid_mass() -> None:
    with pytest.raises(InvalidInputError, match="mass must be a positive number, found 0"):
        HandImpedance(FR3_LIMITS, NO_DRIVES, mass=0.0)
