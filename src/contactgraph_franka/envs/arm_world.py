"""The simulated arm over its table, with blocks that its fingers grasp."""

import math
from collections.abc import Callable

import numpy as np

from contactgraph.envs.mujoco_world import SIMULATOR
from contactgraph_franka.envs.arm_model import JOINTS, Impedance, JointLimitBrakes, arm_xml, mujoco
from contactgraph_franka.envs.pickup import BLOCK_MASS, Grasp

OPEN = 0.03
"""Distance of each open finger from the middle, m."""
HALF_BLOCK = 0.02
"""Half the width of a block, m."""
SPEED = 0.05
"""Largest speed of each finger, m/s; the maker's."""
REACH = 0.01
"""Distance of the grasp point from a block's centre at which the fingers meet it, m."""
LAG = 0.03
"""Delay of the fingers behind their command, s."""
LOST = 0.03
"""Distance of a block at which closing fingers open again, m."""
MISS = 0.022
"""Least distance from the grasp point of a passing block that is not grasped, m."""
_BLOCK = """
<body name="block{index}" pos="{x} {y} {z}" euler="0 0 {yaw}">
  <freejoint/><geom name="block{index}" class="block" mass="{mass}" rgba="{colour}"/>
</body>"""


class ArmWorld:
    """The hand (node 0) and blocks, stepped by ``dt`` s under torque control at 1 kHz."""

    def __init__(
        self,
        joints: np.ndarray,
        blocks: np.ndarray,
        yaw: np.ndarray,
        dt: float,
        grasp: Grasp = Grasp.FRICTION,
    ) -> None:
        """``joints`` [7] rad; positions ``blocks`` [M, 3] m and ``yaw`` [M] rad of the blocks."""
        self.metadata = {"simulator": SIMULATOR}
        self.description = _scene_xml(blocks, yaw)
        """The MJCF of the scene."""
        self.model = mujoco.MjModel.from_xml_string(self.description)
        self.data = mujoco.MjData(self.model)
        model, data = self.model, self.data
        data.qpos[:JOINTS] = joints
        self._weld = grasp is Grasp.WELD
        self._reflex = GraspReflex()
        data.qpos[JOINTS : JOINTS + 2] = self._reflex.opening
        mujoco.mj_forward(model, data)
        self.impedance = Impedance(model, data)
        self.brakes = JointLimitBrakes(model, data)
        self._contacts = _Contacts(model, data, len(blocks))
        self._touched: set[int] = set()
        self._substeps = round(dt / model.opt.timestep)
        # Views of MuJoCo's arrays. Blocks are the last bodies, each with 6 velocities.
        self._hand_position = data.site_xpos[model.site("grasp").id]
        self._block_position = data.xpos[model.nbody - len(blocks) :]
        self._block_velocity = data.qvel[JOINTS + 2 :].reshape(-1, 6)[:, :3]
        links = [model.body(f"link{index}").id for index in range(8)]
        self._links = [*links, model.body("hand").id]
        self._bodies = [self._links[-1], *range(model.nbody - len(blocks), model.nbody)]

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
        """[N, N] bool: contacts between blocks, and of a finger with a block in the last step."""
        count = len(self._block_position)
        contact = np.zeros((1 + count, 1 + count), bool)
        contact[1:, 1:] = self._contacts.between_blocks()
        touched = [1 + index for index in self._touched]
        contact[0, touched] = contact[touched, 0] = True
        return contact

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under ``force`` [N, 3] N; the arm's controller adds to the hand's."""
        self.step_under(lambda part: force[0], np.where(np.arange(len(force))[:, None], force, 0.0))

    def step_under(
        self, force_at: Callable[[float], np.ndarray], pushed: np.ndarray | None = None
    ) -> np.ndarray:
        """Advances by ``dt``; ``force_at(part)`` is the force [3] N on the hand every millisecond.

        ``part``, in [0, 1), is the elapsed share of the step. ``pushed`` [N, 3] N acts on hand and
        blocks from outside. Returns the mean force.
        """
        model, data = self.model, self.data
        outer = data.xfrc_applied[self._bodies, :3]
        data.xfrc_applied[self._bodies, :3] = outer + (0.0 if pushed is None else pushed)
        self._touched = set()
        self.brakes.check(self.impedance.turn)
        total = np.zeros(3)
        for substep in range(self._substeps):
            force = force_at(substep / self._substeps)
            total += force
            torque = self.impedance(force)
            # Closed brakes bear the load; the motors, the arm's own weight.
            data.ctrl[:JOINTS] = data.qfrc_bias[:JOINTS] if self.brakes.closed else torque
            touched, grasped = self._contacts.fingers()
            self._touched |= touched
            if self._weld and grasped:
                self._weld_to(grasped[0])
            offset = self._block_position - self._hand_position
            velocity = self.impedance.velocity - self._block_velocity
            data.ctrl[JOINTS] = self._reflex.step(
                offset, velocity, bool(grasped), model.opt.timestep
            )
            before = data.qvel.copy()
            mujoco.mj_step2(model, data)
            self.impedance.observe(before)
            mujoco.mj_step1(model, data)
        data.xfrc_applied[self._bodies, :3] = outer
        return total / self._substeps

    def link_positions(self) -> np.ndarray:
        """[P, 3] m: the arm's joints from the base to the grasp point."""
        return np.concatenate([self.data.xpos[self._links], self._hand_position[None]])

    def _weld_to(self, index: int) -> None:
        """Welds a block to the hand in their present relative pose, if it is not yet."""
        weld = self.model.equality(f"weld{index}").id
        if self.data.eq_active[weld]:
            return
        hand, block = self.data.body("hand"), self.data.body(f"block{index}")
        inverse, turn, relative = np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(inverse, hand.xquat)
        mujoco.mju_rotVecQuat(relative, block.xpos - hand.xpos, inverse)
        mujoco.mju_mulQuat(turn, inverse, block.xquat)
        # The anchor on the block, then its position and orientation in the hand's frame.
        self.model.eq_data[weld, :3] = 0.0
        self.model.eq_data[weld, 3:6] = relative
        self.model.eq_data[weld, 6:10] = turn
        self.data.eq_active[weld] = 1


class GraspReflex:
    """Closes the fingers so that they meet on a passing block, and opens them if it is lost.

    The fingers touch a block as the grasp point comes within `REACH` of its centre; they begin to
    close as much earlier as their largest speed requires.
    """

    def __init__(self) -> None:
        self.opening = OPEN
        """Commanded distance of each finger from the middle, m."""

    def step(self, offset: np.ndarray, velocity: np.ndarray, grasped: bool, dt: float) -> float:
        """The commanded distance of each finger from the middle, m.

        ``offset`` [M, 3] m from the grasp point to the blocks; ``velocity`` [M, 3] m/s of the
        grasp point relative to them; ``grasped``: whether both fingers touch a block.
        """
        if grasped:
            self.opening = 0.0
            return self.opening
        nearest_square, soonest = math.inf, math.inf
        # Python floats: at 1 kHz, arrays of three take longer than the arithmetic.
        for (x, y, z), (u, v, w) in zip(offset.tolist(), velocity.tolist(), strict=True):
            distance_square = x * x + y * y + z * z
            closing = x * u + y * v + z * w
            nearest_square = min(nearest_square, distance_square)
            soonest = min(soonest, _time_to(distance_square, closing, u * u + v * v + w * w))
        soonest -= LAG
        if self.opening <= HALF_BLOCK and nearest_square < LOST**2:
            soonest = 0.0
        wanted = 0.0 if soonest <= 0.0 else min(OPEN, HALF_BLOCK + SPEED * soonest)
        self.opening = min(max(wanted, self.opening - SPEED * dt), OPEN)
        return self.opening


class _Contacts:
    """Contacts of the finger pads and of ``count`` blocks, from MuJoCo's list of contacts."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
        self._data, self._count = data, count
        self._block = {model.geom(f"block{index}").id: index for index in range(count)}
        self._pad = {model.geom("left_pad").id: 0, model.geom("right_pad").id: 1}

    def fingers(self) -> tuple[set[int], list[int]]:
        """Indices of the blocks that any finger touches, and in order those that both touch."""
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


def _time_to(distance_square: float, closing: float, speed_square: float) -> float:
    """Time until the grasp point is within `REACH` of a block, or else nearest to it, s.

    0 if it is within reach, infinity if it passes too far off or recedes. ``distance_square`` m^2;
    ``closing`` m^2/s, the distance times the closing speed; ``speed_square`` m^2/s^2.
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


def _scene_xml(position: np.ndarray, yaw: np.ndarray) -> str:
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
        for index, ((x, y, z), angle) in enumerate(zip(position, yaw, strict=True))
    )
    welds = "".join(
        f'<weld name="weld{index}" body1="hand" body2="block{index}" active="false"/>'
        for index in range(len(position))
    )
    return arm_xml().replace(
        "</worldbody>\n  <equality>", f"{blocks}</worldbody>\n  <equality>{welds}"
    )
