"""What the fingers do by themselves: they close so that they meet on a block that passes."""

import math
from collections.abc import Callable
from importlib.resources import files

import numpy as np

from contactgraph_franka.envs.arm_model import JOINTS, Impedance, JointLimitBrakes, mujoco
from contactgraph_franka.envs.pickup import Grasp

OPEN = 0.03
"""Way of each finger from the middle while there is nothing to grasp, m."""
HALF_BLOCK = 0.02
"""Half the width of a block, m."""
SPEED = 0.05
"""Of each finger, m/s; the maker's largest."""
REACH = 0.01
"""Distance of the grasp point from a block's centre at which the fingers meet it, m."""
LAG = 0.03
"""Of the fingers behind where they are sent, s."""
LOST = 0.03
"""Fingers that close on a block open again once it is farther away than this, m."""
MISS = 0.022
"""A block that passes farther from the grasp point than this is not grasped, m."""


class GraspReflex:
    """Closes the fingers in time, holds what they hold, and opens them again if it is lost.

    The fingers touch a block as the grasp point comes within 0.01 m of its centre: they begin
    to close as long before as they need at their largest speed.
    """

    def __init__(self) -> None:
        self.way = OPEN
        """Where the fingers are sent, m from the middle."""

    def step(self, offset: np.ndarray, velocity: np.ndarray, held: bool, dt: float) -> float:
        """Where to send each finger, m from the middle.

        ``offset`` [M, 3] m from the grasp point to the blocks; ``velocity`` [M, 3] m/s of the
        grasp point against them; ``held``: whether both fingers touch a block.
        """
        if held:
            self.way = 0.0
            return self.way
        nearest_square, soonest = math.inf, math.inf
        # Plain numbers: at a kilohertz, arrays of three take longer than what they are asked.
        for (x, y, z), (u, v, w) in zip(offset.tolist(), velocity.tolist(), strict=True):
            distance_square = x * x + y * y + z * z
            closing = x * u + y * v + z * w
            nearest_square = min(nearest_square, distance_square)
            soonest = min(soonest, _time_to(distance_square, closing, u * u + v * v + w * w))
        soonest -= LAG
        if self.way <= HALF_BLOCK and nearest_square < LOST**2:
            soonest = 0.0
        wanted = 0.0 if soonest <= 0.0 else min(OPEN, HALF_BLOCK + SPEED * soonest)
        self.way = min(max(wanted, self.way - SPEED * dt), OPEN)
        return self.way


def _time_to(distance_square: float, closing: float, speed_square: float) -> float:
    """s until the grasp point is within `REACH` of a block, or, if it never comes as near, nearest
    to it; 0 where it is, infinity where it passes too far off or moves away.

    ``distance_square`` m^2; ``closing`` m^2/s is distance times the speed at which it shrinks;
    ``speed_square`` m^2/s^2.
    """
    if distance_square <= REACH**2:
        return 0.0
    if closing <= 0.0:
        return math.inf
    speed_square = max(speed_square, 1e-12)
    nearest_square = max(distance_square - closing * closing / speed_square, 0.0)
    if nearest_square > MISS**2:
        return math.inf
    root = math.sqrt(max(REACH**2 - nearest_square, 0.0) * speed_square)
    return (closing - root) / speed_square


class FingerContacts:
    """The contacts of the finger pads and of ``count`` blocks, whose geoms are ``block0`` and on.

    Plain numbers in loops: it is asked at every tick, and arrays as small as these take longer.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
        self._data = data
        self._count = count
        self._block = {model.geom(f"block{index}").id: index for index in range(count)}
        self._pad = {model.geom("left_pad").id: 0, model.geom("right_pad").id: 1}

    def fingers(self) -> tuple[set[int], list[int]]:
        """The blocks, by index, that any finger touches, and in order those that both touch."""
        touched: tuple[set[int], set[int]] = set(), set()
        for one, other in self._data.contact.geom.tolist():
            if one in self._pad:
                touched[self._pad[one]].add(other)
            elif other in self._pad:
                touched[self._pad[other]].add(one)
        left, right = ({self._block[g] for g in side if g in self._block} for side in touched)
        return left | right, sorted(left & right)

    def between_blocks(self) -> np.ndarray:
        """[M, M] bool, symmetric."""
        contact = np.zeros((self._count, self._count), bool)
        for one, other in self._data.contact.geom.tolist():
            if one in self._block and other in self._block:
                first, second = self._block[one], self._block[other]
                contact[first, second] = contact[second, first] = True
        return contact


BLOCK_MASS = 0.4
"""kg"""
_BLOCK = """
<body name="block{index}" pos="{x} {y} {z}" euler="0 0 {yaw}">
  <freejoint/><geom name="block{index}" class="block" mass="{mass}" rgba="{colour}"/>
</body>"""


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
        self.brakes = JointLimitBrakes(model, data)
        self._touch = FingerContacts(model, data, len(place))
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
