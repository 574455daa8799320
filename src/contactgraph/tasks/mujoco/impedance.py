"""Cartesian impedance of the arm: the hand as a mass that keeps its orientation."""

import numpy as np

from contactgraph.tasks.mujoco.engine import JOINTS, mujoco

APPARENT_MASS = 4.0
"""What the hand feels like to a force, kg: about what the arm weighs there."""
ROTATION_STIFFNESS = 8.0
"""N m/rad"""
ROTATION_DAMPING = 2.0 * np.sqrt(ROTATION_STIFFNESS)
"""N m s/rad"""
_POSTURE_STIFFNESS = 10.0
_POSTURE_DAMPING = 4.0
_FILTER = 0.004
"""Time constant of the estimate of outer torques, s."""


class Impedance:
    r"""Torques with which the hand moves as a mass of 4 kg under a force, orientation held.

    Impedance control with the inertia shaped (Hogan 1985; Khatib 1987): with J the Jacobian of the
    grasp point, $\Lambda = (J M^{-1} J^T)^{-1}$ and $\hat\tau$ the torques from outside as a
    momentum observer estimates them from the last motion (De Luca and Mattone 2003; the arm's own
    software offers the same estimate),

    $$ \tau = J^T \Lambda (a - \dot J \dot q) + h - \hat\tau + \tau_0, \qquad
       a = \big( (u + \hat f) / m,\; \text{stiffness and damping of the rotation} \big), $$

    with h gravity and Coriolis torques and $\tau_0$ what pulls the elbow home without moving the
    hand. Torques stay within the joints' limits.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._site = model.site("grasp").id
        self._hand = int(model.site_bodyid[self._site])
        self._limit = model.jnt_actfrcrange[:JOINTS, 1].copy()
        self._jacobian = np.zeros((6, model.nv))
        self._jacobian_rate = np.zeros((6, model.nv))
        self._solved = np.zeros((6, model.nv))
        self._momentum_rate = np.zeros(model.nv)
        self._now, self._orientation = np.zeros(4), np.zeros(4)
        self.hold()

    def hold(self) -> None:
        """Takes the present orientation and posture as those to keep."""
        mujoco.mju_mat2Quat(self._orientation, self._data.site_xmat[self._site])
        self._home = self._data.qpos[:JOINTS].copy()
        self._outer = np.zeros(JOINTS)
        self.torque = np.zeros(JOINTS)

    @property
    def turn(self) -> np.ndarray:
        """[3] rad; the rotation from the orientation to keep to the present one."""
        mujoco.mju_mat2Quat(self._now, self._data.site_xmat[self._site])
        turn, outer = np.zeros(3), np.zeros(3)
        # In the frame of the orientation to keep; then in that of the world.
        mujoco.mju_subQuat(turn, self._now, self._orientation)
        mujoco.mju_rotVecQuat(outer, turn, self._orientation)
        return outer

    @property
    def velocity(self) -> np.ndarray:
        """[3] m/s of the grasp point."""
        mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], None, self._site)
        return self._jacobian[:3, :JOINTS] @ self._data.qvel[:JOINTS]

    def observe(self, before: np.ndarray) -> None:
        """After a step: what torques came from outside. ``before`` is the velocity before it."""
        model, data = self._model, self._data
        acceleration = (data.qvel - before) / model.opt.timestep
        mujoco.mj_mulM(model, data, self._momentum_rate, acceleration)
        outer = self._momentum_rate[:JOINTS] + data.qfrc_bias[:JOINTS] - self.torque
        share = model.opt.timestep / (_FILTER + model.opt.timestep)
        self._outer += share * (outer - self._outer)

    def __call__(self, force: np.ndarray) -> np.ndarray:
        """The torques [7] N m for a force [3] N; positions and velocities must be up to date."""
        model, data = self._model, self._data
        J, rate = self._jacobian, self._jacobian_rate
        mujoco.mj_jacSite(model, data, J[:3], J[3:], self._site)
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], data.site_xpos[self._site], self._hand)
        mujoco.mj_solveM(model, data, self._solved, J)
        arm, solved = J[:, :JOINTS], self._solved[:, :JOINTS]
        compliance = arm @ solved.T
        inertia = np.linalg.inv(compliance)
        velocity = arm @ data.qvel[:JOINTS]
        outer = inertia @ (solved @ self._outer)
        moment = -ROTATION_STIFFNESS * self.turn - ROTATION_DAMPING * velocity[3:]
        wanted = -(rate @ data.qvel)
        wanted[:3] += (force + outer[:3]) / APPARENT_MASS
        wanted[3:] += compliance[3:, 3:] @ moment
        posture = _POSTURE_STIFFNESS * (self._home - data.qpos[:JOINTS])
        posture -= _POSTURE_DAMPING * data.qvel[:JOINTS]
        task = inertia @ (wanted - solved @ posture)
        torque = arm.T @ task + posture + data.qfrc_bias[:JOINTS] - self._outer
        self.torque = np.clip(torque, -self._limit, self._limit)
        return self.torque
