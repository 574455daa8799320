"""MuJoCo's Panda with the state that an arm's client reports."""

import numpy as np

from contactgraph_franka.driver.arm import JOINTS, ArmState, JointDrives
from contactgraph_franka.driver.impedance import HandImpedance
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
