"""The arm's MuJoCo model: inverse kinematics, impedance control and joint limits."""

import math
import warnings
from importlib.resources import files

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.mujoco_world import mujoco as mujoco
from contactgraph_franka.envs.pickup import APPARENT_MASS

JOINTS = 7
HOME = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 1.9, np.pi / 4])
"""rad; the posture that resolves the redundancy of the elbow."""
LARGEST_TURN = np.radians(2.0)
"""Largest deviation of the hand from its orientation, rad."""
LARGEST_SPEED = 1.5 * np.array([2.175] * 4 + [2.61] * 3)
"""Largest joint speeds, rad/s: 1.5 times the maker's, which fast sweeps near the base need."""
ROTATION_STIFFNESS = 8.0
"""N m/rad"""
ROTATION_DAMPING = 2.0 * math.sqrt(ROTATION_STIFFNESS)
"""N m s/rad"""
_MARGIN = 0.05  # rad, from the joint limits
_TOLERANCE = 1e-5  # m and rad
_ITERATIONS = 200
_PREDICTION = 0.01  # s, over which a joint is extrapolated to its limit
_LIMIT_TOLERANCE = 0.01  # rad
_BRAKE_DAMPING = 500.0  # N m s/rad
_POSTURE_STIFFNESS = 10.0
_POSTURE_DAMPING = 4.0
_FILTER = 0.004  # s, time constant of the estimate of external torques


def arm_xml() -> str:
    """The MJCF of the arm over its table."""
    return files("contactgraph_franka.envs").joinpath("panda.xml").read_text()


def open_renderer(
    model: mujoco.MjModel, height: int, width: int, purpose: str
) -> "mujoco.Renderer":
    """A renderer without a screen; ``purpose`` begins the `InvalidInputError` without OpenGL."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # GLFW reports its failure as a warning.
            return mujoco.Renderer(model, height, width)
    except Exception as error:
        raise InvalidInputError(
            f"{purpose} OpenGL without a screen: set MUJOCO_GL=egl before Python "
            "starts (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri)"
        ) from error


def inverse_kinematics(model: mujoco.MjModel, point: np.ndarray, yaw: float) -> np.ndarray:
    """Joint angles [7] rad with the grasp point at ``point`` [3] m, pointing down at ``yaw`` rad.

    Damped least squares, with `HOME` as the secondary task. Raises `InvalidInputError` for a point
    out of reach.
    """
    data = mujoco.MjData(model)
    joints = HOME.copy()
    site = model.site("grasp").id
    low, high = model.jnt_range[:JOINTS, 0] + _MARGIN, model.jnt_range[:JOINTS, 1] - _MARGIN
    jacobian = np.zeros((6, model.nv))
    wanted, now, turn, miss = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(6)
    cos, sin = np.cos(yaw), np.sin(yaw)
    mujoco.mju_mat2Quat(wanted, np.array([cos, sin, 0.0, sin, -cos, 0.0, 0.0, 0.0, -1.0]))
    for index in range(_ITERATIONS):
        data.qpos[:JOINTS] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mju_mat2Quat(now, data.site_xmat[site])
        mujoco.mju_subQuat(turn, wanted, now)
        mujoco.mju_rotVecQuat(miss[3:], turn, now)
        miss[:3] = point - data.site_xpos[site]
        if np.max(np.abs(miss)) < _TOLERANCE:
            return joints
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        J = jacobian[:, :JOINTS]
        inverse = J.T @ np.linalg.inv(J @ J.T + 1e-4 * np.eye(6))
        home = 0.1 * 0.95**index * (HOME - joints)
        joints = np.clip(joints + inverse @ miss + home - inverse @ (J @ home), low, high)
    raise InvalidInputError(
        f"the hand cannot be at {np.round(point, 3).tolist()} m; it reaches x 0.3 to 0.7, "
        "y -0.35 to 0.35, z 0.05 to 0.35"
    )


class JointLimitBrakes:
    """Closes the brakes for good, as the maker's controller does, once the arm exceeds its limits.

    The limits are those of the joints' ranges and speeds and of the hand's orientation. Forces that
    push the hand out of its reach or slam it onto something exceed them; sweeps do not.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model = model
        self._joints, self._velocity = data.qpos[:JOINTS], data.qvel[:JOINTS]
        low, high = model.jnt_range[:JOINTS].T
        self._low, self._high = low - _LIMIT_TOLERANCE, high + _LIMIT_TOLERANCE
        self.closed = False

    def check(self, turn: np.ndarray) -> None:
        """Closes the brakes if a limit is exceeded; ``turn`` [3] rad is the hand's deviation."""
        soon = self._joints + _PREDICTION * self._velocity
        fits = np.all((self._low < soon) & (soon < self._high))
        slow = np.all(np.abs(self._velocity) < LARGEST_SPEED)
        if not (fits and slow and turn @ turn < LARGEST_TURN**2):
            self.closed = True
            self._model.dof_damping[:JOINTS] = _BRAKE_DAMPING


class Impedance:
    r"""Torques under which the hand moves as a mass of 4 kg that keeps its orientation.

    Impedance control with inertia shaping (Hogan 1985; Khatib 1987): with J the Jacobian of the
    grasp point, $\Lambda = (J M^{-1} J^T)^{-1}$ and $\hat\tau$ the external torques estimated by a
    momentum observer (De Luca and Mattone 2003; the arm's own software has one too),

    $$ \tau = J^T \Lambda (a - \dot J \dot q) + h - \hat\tau + \tau_0, \qquad
       a = \big( (u + \hat f) / m,\; \text{stiffness and damping of the rotation} \big), $$

    with h gravity and Coriolis torques and $\tau_0$ the null-space torque towards the initial
    posture. Torques stay within the joints' limits.
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
        # Views of MuJoCo's arrays: at 1 kHz, slicing takes noticeable time.
        self._position, self._frame = data.site_xpos[self._site], data.site_xmat[self._site]
        self._joints, self._joint_velocity = data.qpos[:JOINTS], data.qvel[:JOINTS]
        self._bias = data.qfrc_bias[:JOINTS]
        self._linear, self._angular = jacobian[:3], jacobian[3:]
        self._linear_rate, self._angular_rate = rate[:3], rate[3:]
        self._arm, self._arm_solved = jacobian[:, :JOINTS], self._solved[:, :JOINTS]
        self._now, self._orientation = np.zeros(4), np.zeros(4)
        self.hold()

    def hold(self) -> None:
        """Makes the present orientation and posture the desired ones."""
        mujoco.mju_mat2Quat(self._orientation, self._frame)
        self._home = self._joints.copy()
        self._external = np.zeros(JOINTS)
        self.torque = np.zeros(JOINTS)

    @property
    def turn(self) -> np.ndarray:
        """[3] rad: rotation vector from the desired orientation to the present one."""
        mujoco.mju_mat2Quat(self._now, self._frame)
        local, world = np.zeros(3), np.zeros(3)
        mujoco.mju_subQuat(local, self._now, self._orientation)
        mujoco.mju_rotVecQuat(world, local, self._orientation)
        return world

    @property
    def velocity(self) -> np.ndarray:
        """[3] m/s of the grasp point."""
        mujoco.mj_jacSite(self._model, self._data, self._linear, None, self._site)
        return self._arm[:3] @ self._joint_velocity

    def observe(self, before: np.ndarray) -> None:
        """Updates the external torques after a step; ``before`` is the velocity before it."""
        acceleration = (self._data.qvel - before) / self._dt
        mujoco.mj_mulM(self._model, self._data, self._momentum_rate, acceleration)
        external = self._momentum_rate[:JOINTS] + self._bias - self.torque
        self._external += self._dt / (_FILTER + self._dt) * (external - self._external)

    def __call__(self, force: np.ndarray) -> np.ndarray:
        """The torques [7] N m for a force [3] N; positions and velocities must be up to date."""
        model, data, J, solved = self._model, self._data, self._arm, self._arm_solved
        mujoco.mj_jacSite(model, data, self._linear, self._angular, self._site)
        mujoco.mj_jacDot(
            model, data, self._linear_rate, self._angular_rate, self._position, self._hand
        )
        mujoco.mj_solveM(model, data, self._solved, self._jacobian)
        compliance = J @ solved.T
        inertia = np.linalg.inv(compliance)
        rotation = J[3:] @ self._joint_velocity
        external = inertia @ (solved @ self._external)
        moment = -ROTATION_STIFFNESS * self.turn - ROTATION_DAMPING * rotation
        wanted = -(self._jacobian_rate @ data.qvel)
        wanted[:3] += (force + external[:3]) / APPARENT_MASS
        wanted[3:] += compliance[3:, 3:] @ moment
        posture = _POSTURE_STIFFNESS * (self._home - self._joints)
        posture -= _POSTURE_DAMPING * self._joint_velocity
        task = inertia @ (wanted - solved @ posture)
        torque = J.T @ task + posture + self._bias - self._external
        self.torque = np.minimum(np.maximum(torque, -self._limit), self._limit)
        return self.torque
