"""Reads off MuJoCo what is really so in an `ArmScene`."""

import numpy as np

from contactgraph_franka.envs.engine import JOINTS, mujoco
from contactgraph_franka.sim.arm_scene import TICK, ArmScene

_FIRST = JOINTS + 2
"""The arm's joints and fingers come first, in positions as in velocities."""


class Observer:
    """Fills a row of `truth_type` with the present of ``scene``."""

    def __init__(self, scene: ArmScene, row: np.ndarray) -> None:
        model, data = scene.model, scene.data
        self._model, self._data, self._row = model, data, row
        count = len(scene.blocks)
        self._site = model.site("grasp").id
        self._twist, self._quaternion = np.zeros(6), np.zeros(4)
        self._hand_place, self._hand_frame = data.site_xpos[self._site], data.site_xmat[self._site]
        self._block_places = data.qpos[_FIRST:].reshape(count, 7)
        self._block_rates = data.qvel[_FIRST:].reshape(count, 6)
        self._fingers = data.qpos[JOINTS:_FIRST]
        block = {model.geom(f"block{index}").id: index for index in range(count)}
        pads = {
            model.geom(f"{side}_pad{number}").id: which
            for which, side in enumerate(("left", "right"))
            for number in range(1, 6)
        }
        ground = model.geom("ground").id
        # What two shapes that touch mean: (block, left or right finger or table).
        self._meaning: dict[tuple[int, int], tuple[int, int]] = {}
        for other, which in {**pads, ground: 2}.items():
            for shape, index in block.items():
                self._meaning[shape, other] = self._meaning[other, shape] = (index, which)
        self._touch = np.zeros((count, 3), bool)

    def fill(self, tick: int, stamp: float) -> None:
        """The state after ``tick`` ticks, ``stamp`` s on the reader's clock."""
        model, data, row = self._model, self._data, self._row
        # A step leaves positions where it ends, but what follows from them where it began.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, self._twist, 0)
        mujoco.mju_mat2Quat(self._quaternion, self._hand_frame)
        self._touch[:] = False
        for pair in data.contact.geom.tolist():
            meaning = self._meaning.get((pair[0], pair[1]))
            if meaning is not None:
                self._touch[meaning] = True
        row["time"], row["stamp"] = (tick + 1) * TICK, stamp
        row["position"][0, 0], row["position"][0, 1:] = self._hand_place, self._block_places[:, :3]
        row["velocity"][0, 0], row["velocity"][0, 1:] = (
            self._twist[3:],
            self._block_rates[:, :3],
        )
        row["turn"][0, 0], row["turn"][0, 1:] = self._quaternion, self._block_places[:, 3:]
        row["fingers"][0], row["standing"][0] = self._touch[:, :2], self._touch[:, 2]
        row["width"] = self._fingers[0] + self._fingers[1]
        row["places"][0] = data.qpos
