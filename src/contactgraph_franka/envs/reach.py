"""Where the hand can be, and with which joints."""

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.engine import JOINTS, mujoco

HOME = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 1.9, np.pi / 4])
"""rad; the elbow is kept about so."""
_MARGIN = 0.05
"""Of the joints' limits, rad."""
_TOLERANCE = 1e-5
_ROUNDS = 200


def joints_at(model: mujoco.MjModel, point: np.ndarray, yaw: float) -> np.ndarray:
    """[7] rad with the grasp point at ``point`` [3] m, pointing down, turned by ``yaw`` rad.

    Damped least squares with the elbow drawn home. Raises `InvalidInputError` where it cannot be.
    """
    data = mujoco.MjData(model)
    joints = HOME.copy()
    site = model.site("grasp").id
    low, high = model.jnt_range[:JOINTS, 0] + _MARGIN, model.jnt_range[:JOINTS, 1] - _MARGIN
    jacobian = np.zeros((6, model.nv))
    wanted, now, turn, miss = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(6)
    cos, sin = np.cos(yaw), np.sin(yaw)
    mujoco.mju_mat2Quat(wanted, np.array([cos, sin, 0.0, sin, -cos, 0.0, 0.0, 0.0, -1.0]))
    for index in range(_ROUNDS):
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
