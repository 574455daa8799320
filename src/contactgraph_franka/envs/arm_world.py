"""The arm over its table, with blocks on it."""

from collections.abc import Callable
from enum import Enum
from importlib.resources import files

import numpy as np

from contactgraph_franka.envs.brakes import Brakes
from contactgraph_franka.envs.engine import JOINTS, mujoco
from contactgraph_franka.envs.impedance import Impedance
from contactgraph_franka.envs.reflex import GraspReflex
from contactgraph_franka.envs.touch import Touch

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
        self.description = _scene(place, yaw)
        """What MuJoCo is told, in its own words."""
        self.model = mujoco.MjModel.from_xml_string(self.description)
        self.data = mujoco.MjData(self.model)
        model, data = self.model, self.data
        data.qpos[:JOINTS] = joints
        self._weld = grasp is Grasp.WELD
        self._reflex = GraspReflex()
        data.qpos[JOINTS : JOINTS + 2] = self._reflex.way
        mujoco.mj_forward(model, data)
        self.impedance = Impedance(model, data)
        self.brakes = Brakes(model, data)
        self._touch = Touch(model, data, len(place))
        self._touched: set[int] = set()
        self._substeps = round(dt / model.opt.timestep)
        # Views of what MuJoCo moves. Blocks are the last bodies, each with 6 velocities.
        self._hand_position = data.site_xpos[model.site("grasp").id]
        self._block_position = data.xpos[model.nbody - len(place) :]
        self._block_velocity = data.qvel[JOINTS + 2 :].reshape(-1, 6)[:, :3]
        links = [model.body(f"link{index}").id for index in range(8)]
        self._links = [*links, model.body("hand").id]

    @property
    def position(self) -> np.ndarray:
        """[N, 3] m: the grasp point, the blocks' centres."""
        return np.concatenate([self._hand_position[None], self._block_position])

    @property
    def velocity(self) -> np.ndarray:
        """[N, 3] m/s."""
        return np.concatenate([self.impedance.velocity[None], self._block_velocity])

    @property
    def contact(self) -> np.ndarray:
        """[N, N] bool: the hand and a block that a finger touched within the last step; blocks
        that touch."""
        count = len(self._block_position)
        contact = np.zeros((1 + count, 1 + count), bool)
        contact[1:, 1:] = self._touch.between_blocks()
        touched = [1 + index for index in self._touched]
        contact[0, touched] = contact[touched, 0] = True
        return contact

    def step(self, force: np.ndarray) -> None:
        """Moves on by ``dt`` under a ``force`` [N, 3] N, of which the hand's counts."""
        self.step_under(lambda part: force[0])

    def step_under(self, force_at: Callable[[float], np.ndarray]) -> np.ndarray:
        """Moves on by ``dt`` under a force [3] N on the hand that is asked for in every tick.

        ``force_at`` is told what part of the step has passed. Returns the mean force.
        """
        model, data = self.model, self.data
        self._touched = set()
        self.brakes.check(self.impedance.turn)
        total = np.zeros(3)
        for tick in range(self._substeps):
            force = force_at(tick / self._substeps)
            total += force
            torque = self.impedance(force)
            # Closed brakes bear the load; the motors, the arm's own weight.
            data.ctrl[:JOINTS] = data.qfrc_bias[:JOINTS] if self.brakes.closed else torque
            touched, held = self._touch.fingers()
            self._touched |= touched
            if self._weld and held:
                self._weld_to(held[0])
            offset = self._block_position - self._hand_position
            velocity = self.impedance.velocity - self._block_velocity
            way = self._reflex.step(offset, velocity, bool(held), model.opt.timestep)
            data.ctrl[JOINTS] = way
            before = data.qvel.copy()
            mujoco.mj_step2(model, data)
            self.impedance.observe(before)
            mujoco.mj_step1(model, data)
        return total / self._substeps

    def skeleton(self) -> np.ndarray:
        """[P, 3] m: the arm's joints from the base to the grasp point."""
        return np.concatenate([self.data.xpos[self._links], self._hand_position[None]])

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


def arm_alone() -> str:
    """The arm over its table, as MuJoCo is told of it."""
    return files("contactgraph_franka.envs").joinpath("panda.xml").read_text()


def _scene(place: np.ndarray, yaw: np.ndarray) -> str:
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
    return arm_alone().replace(
        "</worldbody>\n  <equality>", f"{blocks}</worldbody>\n  <equality>{welds}"
    )
