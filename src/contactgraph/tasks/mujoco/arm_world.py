"""The arm over its table, with blocks on it."""

from enum import Enum
from importlib.resources import files

import numpy as np

from contactgraph.tasks.mujoco.engine import JOINTS, mujoco
from contactgraph.tasks.mujoco.impedance import Impedance
from contactgraph.tasks.mujoco.reflex import GraspReflex

BLOCK = np.array([0.04, 0.04, 0.1])
"""Sides of a block, m."""
BLOCK_MASS = 0.4
"""kg"""
_BLOCK = """
<body name="block{index}" pos="{x} {y} {z}" euler="0 0 {yaw}">
  <freejoint/><geom name="block{index}" class="block" mass="{mass}" rgba="{colour}"/>
</body>"""


class Grasp(Enum):
    """How the hand holds a block."""

    FRICTION = "friction"
    """By what its fingers press."""
    WELD = "weld"
    """Rigidly, from the moment both fingers touch it."""


class ArmWorld:
    """The hand (node 0) and blocks, stepped by ``dt`` at a kilohertz of torque control."""

    def __init__(
        self,
        joints: np.ndarray,
        place: np.ndarray,
        yaw: np.ndarray,
        dt: float,
        grasp: Grasp = Grasp.FRICTION,
    ) -> None:
        """``joints`` [7] rad; ``place`` [M, 3] m and ``yaw`` [M] rad of the blocks."""
        self.model = mujoco.MjModel.from_xml_string(_scene(place, yaw))
        self.data = mujoco.MjData(self.model)
        model, data = self.model, self.data
        data.qpos[:JOINTS] = joints
        self._weld = grasp is Grasp.WELD
        self._reflex = GraspReflex()
        data.qpos[JOINTS : JOINTS + 2] = self._reflex.way
        mujoco.mj_forward(model, data)
        self.impedance = Impedance(model, data)
        self._substeps = round(dt / model.opt.timestep)
        self._site = model.site("grasp").id
        self._hand = int(model.site_bodyid[self._site])
        count = len(place)
        self._bodies = [model.body(f"block{i}").id for i in range(count)]
        self._block = np.full(model.ngeom, -1)
        self._block[[model.geom(f"block{i}").id for i in range(count)]] = np.arange(count)
        self._pad = np.full(model.ngeom, -1)
        self._pad[[model.geom("left_pad").id, model.geom("right_pad").id]] = 0, 1
        self._grasped = np.zeros(count, bool)
        self._start = JOINTS + 2 + 6 * np.arange(count)

    @property
    def position(self) -> np.ndarray:
        """[N, 3] m: the grasp point, the blocks' centres."""
        return np.concatenate([self.data.site_xpos[self._site][None], self.data.xpos[self._bodies]])

    @property
    def velocity(self) -> np.ndarray:
        """[N, 3] m/s."""
        return np.concatenate([self._hand_velocity()[None], self._block_velocity()])

    @property
    def contact(self) -> np.ndarray:
        """[N, N] bool: the hand and a block that both fingers touched at once within the last
        step; blocks that touch."""
        count = len(self._bodies)
        contact = np.zeros((1 + count, 1 + count), bool)
        geoms = self.data.contact.geom
        if len(geoms):
            first, second = self._block[geoms[:, 0]], self._block[geoms[:, 1]]
            both = (first >= 0) & (second >= 0)
            contact[1 + first[both], 1 + second[both]] = True
        contact[0, 1:] = self._grasped
        return contact | contact.T

    def step(self, force: np.ndarray) -> None:
        """Moves on by ``dt`` under a ``force`` [N, 3] N, of which the hand's counts."""
        model, data = self.model, self.data
        self._grasped = np.zeros(len(self._bodies), bool)
        for _ in range(self._substeps):
            data.ctrl[:JOINTS] = self.impedance(force[0])
            offset = data.xpos[self._bodies] - data.site_xpos[self._site]
            velocity = self._hand_velocity() - self._block_velocity()
            held = self._held()
            self._grasped |= held
            if self._weld and held.any():
                self._weld_to(int(np.argmax(held)))
            way = self._reflex.step(offset, velocity, bool(held.any()), model.opt.timestep)
            data.ctrl[JOINTS] = way
            before = data.qvel.copy()
            mujoco.mj_step2(model, data)
            self.impedance.observe(before)
            mujoco.mj_step1(model, data)

    def skeleton(self) -> np.ndarray:
        """[P, 3] m: the arm's joints from the base to the grasp point."""
        names = [f"link{index}" for index in range(8)]
        joints = [self.data.body(name).xpos for name in (*names, "hand")]
        return np.stack([*joints, self.data.site_xpos[self._site]])

    def _weld_to(self, index: int) -> None:
        """Ties a block to the hand as the two are now; a weld that is there stays."""
        weld = self.model.equality(f"weld{index}").id
        if self.data.eq_active[weld]:
            return
        hand, block = self.data.body("hand"), self.data.body(f"block{index}")
        back, turn, relative = np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, hand.xquat)
        mujoco.mju_rotVecQuat(relative, block.xpos - hand.xpos, back)
        mujoco.mju_mulQuat(turn, back, block.xquat)
        # Anchor on the block, then its place and orientation in the hand's frame.
        self.model.eq_data[weld, :3] = 0.0
        self.model.eq_data[weld, 3:6] = relative
        self.model.eq_data[weld, 6:10] = turn
        self.data.eq_active[weld] = 1

    def _held(self) -> np.ndarray:
        """[M] bool: whether both fingers touch a block."""
        geoms = self.data.contact.geom
        touched = np.zeros((2, len(self._bodies)), bool)
        if len(geoms):
            for one, other in ((0, 1), (1, 0)):
                pad, block = self._pad[geoms[:, one]], self._block[geoms[:, other]]
                both = (pad >= 0) & (block >= 0)
                touched[pad[both], block[both]] = True
        return touched[0] & touched[1]

    def _hand_velocity(self) -> np.ndarray:
        return self.impedance.velocity

    def _block_velocity(self) -> np.ndarray:
        return np.stack([self.data.qvel[at : at + 3] for at in self._start])


def _scene(place: np.ndarray, yaw: np.ndarray) -> str:
    arm = files("contactgraph.tasks.mujoco").joinpath("panda.xml").read_text()
    blocks = "".join(
        _BLOCK.format(
            index=index,
            x=x,
            y=y,
            z=z,
            yaw=angle,
            mass=BLOCK_MASS,
            colour=".2 .6 .3 1" if index else ".8 .3 .2 1",
        )
        for index, ((x, y, z), angle) in enumerate(zip(place, yaw, strict=True))
    )
    welds = "".join(
        f'<weld name="weld{index}" body1="hand" body2="block{index}" active="false"/>'
        for index in range(len(place))
    )
    return arm.replace("</worldbody>\n  <equality>", f"{blocks}</worldbody>\n  <equality>{welds}")
