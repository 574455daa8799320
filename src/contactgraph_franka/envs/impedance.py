"""Cartesian impedance of the arm: the hand as a mass that keeps its orientation."""

import math

import numpy as np

from contactgraph_franka.envs.engine import JOINTS, mujoco
from contactgraph_franka.envs.franka_pickup import APPARENT_MASS

ROTATION_STIFFNESS = 8.0
"""N m/rad"""
ROTATION_DAMPING = 2.0 * math.sqrt(ROTATION_STIFFNESS)
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
        self._dt = model.opt.timestep
        self._site = model.site("grasp").id
        self._hand = int(model.site_bodyid[self._site])
        self._limit = model.jnt_actfrcrange[:JOINTS, 1].copy()
        jacobian, rate = np.zeros((2, 6, model.nv))
        self._jacobian, self._jacobian_rate = jacobian, rate
        self._solved = np.zeros((6, model.nv))
        self._momentum_rate = np.zeros(model.nv)
        # Views of what MuJoCo and the ticks move: at a kilohertz, even slicing takes its time.
        self._place, self._frame = data.site_xpos[self._site], data.site_xmat[self._site]
        self._joints, self._joint_velocity = data.qpos[:JOINTS], data.qvel[:JOINTS]
        self._bias = data.qfrc_bias[:JOINTS]
        self._linear, self._angular = jacobian[:3], jacobian[3:]
        self._linear_rate, self._angular_rate = rate[:3], rate[3:]
        self._arm, self._arm_solved = jacobian[:, :JOINTS], self._solved[:, :JOINTS]
        self._now, self._orientation = np.zeros(4), np.zeros(4)
        self.hold()

    def hold(self) -> None:
        """Takes the present orientation and posture as those to keep."""
        mujoco.mju_mat2Quat(self._orientation, self._frame)
        self._home = self._joints.copy()
        self._outer = np.zeros(JOINTS)
        self.torque = np.zeros(JOINTS)

    @property
    def turn(self) -> np.ndarray:
        """[3] rad; the rotation from the orientation to keep to the present one."""
        mujoco.mju_mat2Quat(self._now, self._frame)
        turn, outer = np.zeros(3), np.zeros(3)
        # In the frame of the orientation to keep; then in that of the world.
        mujoco.mju_subQuat(turn, self._now, self._orientation)
        mujoco.mju_rotVecQuat(outer, turn, self._orientation)
        return outer

    @property
    def velocity(self) -> np.ndarray:
        """[3] m/s of the grasp point."""
        mujoco.mj_jacSite(self._model, self._data, self._linear, None, self._site)
        return self._arm[:3] @ self._joint_velocity

    def observe(self, before: np.ndarray) -> None:
        """After a step: what torques came from outside. ``before`` is the velocity before it."""
        acceleration = (self._data.qvel - before) / self._dt
        mujoco.mj_mulM(self._model, self._data, self._momentum_rate, acceleration)
        outer = self._momentum_rate[:JOINTS] + self._bias - self.torque
        self._outer += self._dt / (_FILTER + self._dt) * (outer - self._outer)

    def __call__(self, force: np.ndarray) -> np.ndarray:
        """The torques [7] N m for a force [3] N; positions and velocities must be up to date."""
        model, data, J, solved = self._model, self._data, self._arm, self._arm_solved
        mujoco.mj_jacSite(model, data, self._linear, self._angular, self._site)
        mujoco.mj_jacDot(
            model, data, self._linear_rate, self._angular_rate, self._place, self._hand
        )
        mujoco.mj_solveM(model, data, self._solved, self._jacobian)
        compliance = J @ solved.T
        inertia = np.linalg.inv(compliance)
        rotation = J[3:] @ self._joint_velocity
        outer = inertia @ (solved @ self._outer)
        moment = -ROTATION_STIFFNESS * self.turn - ROTATION_DAMPING * rotation
        wanted = -(self._jacobian_rate @ data.qvel)
        wanted[:3] += (force + outer[:3]) / APPARENT_MASS
        wanted[3:] += compliance[3:, 3:] @ moment
        posture = _POSTURE_STIFFNESS * (self._home - self._joints)
        posture -= _POSTURE_DAMPING * self._joint_velocity
        task = inertia @ (wanted - solved @ posture)
        torque = J.T @ task + posture + self._bias - self._outer
        self.torque = np.minimum(np.maximum(torque, -self._limit), self._limit)
        return self.torque
