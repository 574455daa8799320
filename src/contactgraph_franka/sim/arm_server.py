"""A simulated arm over a table with tagged blocks. The one module that imports franky_sim."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.arm_model import JOINTS, mujoco
from contactgraph_franka.loop.realtime import realtime_priority
from contactgraph_franka.sim.blocks import CONTACT, MASS, WOOD_FRICTION, scene_blocks
from contactgraph_franka.sim.session import read_session
from contactgraph_franka.sim.shared_state import (
    GroundTruthWriter,
    SceneResetService,
    ServerCounters,
)

try:
    from franky_sim import RobotParameters, SimulationServer
    from franky_sim.mujoco_simulator import MujocoSimulator
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "a rehearsal needs franky-sim: pip install 'contactgraph[rehearsal]'"
    ) from error

TICK = 0.001
"""s, of the arm's controller."""
START = (0.0, -0.2849, 0.0, -2.3967, 0.0, 2.1118, np.pi / 4)
"""rad: the grasp point at (0.45, 0, 0.3) m, the hand pointing down."""
GRASP_POINT = (0.0, 0.0, 0.1254)
"""m, in the hand's frame: where a block's centre is when the fingers hold it, 22 mm beyond the
middle of their pads. A block 0.1 m high would meet the palm if they held its middle."""
_STIFFNESS = (600.0, 600.0, 400.0, 400.0, 50.0, 50.0, 20.0)
"""N m/rad, of the arm's own joint controller, which holds it while nobody commands torques."""
_DAMPING = (25.0, 40.0, 20.0, 20.0, 1.0, 1.0, 0.2)
"""N m s/rad. More than an inertia a tick is unstable, and nothing but inertia is in the joints."""
_SPINDLE = "2"
"""kg, what a finger's drive feels like. With franky-sim's 0.2 its speed controller overshoots, and
fingers close twice as fast as they are told."""
_SKIN_FRICTION = ".6 .01 .0001"
"""Of pads on a block, as in the arm's task."""
# The hand's own mass, with the two fingers of 0.015 kg that MuJoCo's model adds to it. Its frame is
# turned by an eighth against the flange's, in which the arm is told of it.
_FINGERS = 0.03
_HAND = 0.73
_HAND_CENTRE = (-0.01, 0.0, 0.03)
_FINGERS_CENTRE = (0.0, 0.0, 0.0584)
_HAND_INERTIA = (0.001, 0.0025, 0.0017)


class ArmScene:
    """franky-sim's arm with a table at z = 0 and ``blocks`` tagged blocks.

    What differs from the scene that franky-sim makes by itself: joints have neither friction nor
    motor inertia, since a real arm's commanded torques are those behind its gears, "without gravity
    and friction" (libfranka's `Torques`); the controller that holds the arm meanwhile is soft
    enough for that; fingers keep to the speed that they are told; links collide with nothing, the
    hand with blocks and table; contacts are those of the arm's task (`tasks/mujoco/panda.xml`).

    Use as a context manager. Raises `InvalidInputError` for a count that there are no tags for.
    """

    def __init__(self, blocks: int = 1, mass: float = MASS) -> None:
        self.blocks = scene_blocks(blocks, mass)
        """Node 1 and on; node 0 is the hand."""
        self._simulator = MujocoSimulator()

    def __enter__(self) -> "ArmScene":
        self._simulator.init()
        self.robot = self._simulator.add_robot(
            initial_q=START, robot_parameters=_hand_parameters(), kp=_STIFFNESS, kv=_DAMPING
        )
        """franky-sim's own, for its torques and fingers."""
        scene = self._simulator.scene
        _as_behind_gears(scene)
        _as_in_the_task(scene)
        for block in self.blocks:
            block.append_to(scene)
        self.description = ElementTree.tostring(scene, encoding="unicode")
        """What MuJoCo is told: for a renderer's copy."""
        return self

    def __exit__(self, *_: object) -> None:
        self._simulator.cleanup()

    @property
    def model(self) -> mujoco.MjModel:
        """Since `start` or `server`."""
        return self._simulator.model

    @property
    def data(self) -> mujoco.MjData:
        """Since `start` or `server`."""
        return self._simulator.data

    def start(self) -> None:
        """Sets all up to be stepped from here, without a server."""
        self._simulator.start()

    @contextmanager
    def server(self, address: str) -> Iterator[list[Any]]:
        """Sets all up behind the arm's protocol at ``address``.

        Gives franky-sim's servers: in every tick they `process_commands` before `step`, and
        `send_state` after it.
        """
        with SimulationServer(self._simulator, hostname_candidates=[address]) as server:
            yield server.robot_servers

    def step(self) -> None:
        """Moves on by a tick under the last torques."""
        self._simulator.step()

    def place_block(self, index: int, position: np.ndarray, yaw: float) -> None:
        """Puts block ``index`` at ``position`` [3] m, turned by ``yaw`` rad, at rest."""
        first = 6 * index
        place = self.data.qpos[JOINTS + 2 + 7 * index :][:7]
        place[:3] = position
        place[3:] = np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)
        self.data.qvel[JOINTS + 2 + first :][:6] = 0.0
        # Contacts of the old place must not be where the next step starts from.
        self.data.qacc_warmstart[:] = 0.0
        mujoco.mj_forward(self.model, self.data)


def _hand_parameters() -> "RobotParameters":
    """So that the arm bears the weight of its hand, fingers included, to the last gram."""
    mass = _HAND + _FINGERS
    centres = np.array([_HAND_CENTRE, _FINGERS_CENTRE])
    centre = (_HAND * centres[0] + _FINGERS * centres[1]) / mass
    inertia = np.diag(_HAND_INERTIA)
    for part, off in zip((_HAND, _FINGERS), centres - centre, strict=True):
        inertia += part * (off @ off * np.eye(3) - np.outer(off, off))
    half = np.sqrt(0.5)
    turn = np.array([[half, half, 0.0], [-half, half, 0.0], [0.0, 0.0, 1.0]])
    return RobotParameters(
        ee_mass=mass,
        ee_com=tuple((turn @ centre).tolist()),
        ee_inertia=tuple((turn @ inertia @ turn.T).ravel().tolist()),
    )


def _as_behind_gears(scene: ElementTree.Element) -> None:
    for joint in scene.iterfind("worldbody//joint"):
        if "fr3_joint" in joint.get("name", ""):
            joint.attrib.update(frictionloss="0", armature="0", damping="0")
        elif "finger_joint" in joint.get("name", ""):
            joint.attrib.update(armature=_SPINDLE)


def _as_in_the_task(scene: ElementTree.Element) -> None:
    option = _found(scene, "option")
    option.attrib.update(cone="elliptic", impratio="10")
    hand = _found(scene, "worldbody//body[@name='robot0_hand']")
    ElementTree.SubElement(
        hand, "site", name="grasp", pos=" ".join(str(number) for number in GRASP_POINT)
    )
    skin = _found(scene, "default//default[@class='collision']/geom")
    skin.attrib.update(CONTACT, friction=_SKIN_FRICTION)
    _found(scene, "worldbody/geom[@name='ground']").attrib.update(CONTACT, friction=WOOD_FRICTION)
    for shape in scene.iterfind("worldbody//geom[@mesh]"):
        if "fr3_link" in shape.get("name", ""):
            shape.attrib.update(contype="0", conaffinity="0")
    for side in ("left", "right"):
        finger = _found(scene, f"worldbody//body[@name='robot0_{side}_finger']")
        for shape in finger.iterfind("geom[@class]"):
            if shape.get("class", "").startswith("fingertip_pad"):
                number = shape.get("class", "")[-1]
                shape.set("name", f"{side}_pad{number}")


def _found(scene: ElementTree.Element, path: str) -> ElementTree.Element:
    part = scene.find(path)
    if part is None:
        raise InvalidInputError(f"franky-sim's scene has no {path}: another version than 1.0?")
    return part


_FIRST = JOINTS + 2
"""The arm's joints and fingers come first, in positions as in velocities."""


class GroundTruthReader:
    """Fills a row of `ground_truth_dtype` with the present of ``scene``."""

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


_CATCH_UP = 10
"""Ticks behind time that are made up for at once; more are left out, as if time had stood still."""
_LOOK = 100
"""Ticks between looks whether the owner still lives."""


def main() -> None:
    """Serves until the owner ends."""
    folder = Path(sys.argv[1])
    session = read_session(folder)
    with ArmScene(session.blocks, session.mass) as scene:
        (folder / "scene.xml").write_text(scene.description)
        with scene.server(session.address) as ends:
            truth = GroundTruthWriter(folder, session.blocks, scene.model.nq)
            counters = ServerCounters(folder, scene.model.nq, session.pace * TICK)
            # As an arm's own computer does, it goes first where cores are few.
            with realtime_priority():
                _serve(scene, ends, truth, counters, SceneResetService(folder), session.pace)


def _serve(
    scene: ArmScene,
    ends: list,
    truth: GroundTruthWriter,
    counters: ServerCounters,
    orders: SceneResetService,
    pace: float,
) -> None:
    """Ticks by absolute times: what one loses in sleeping too long, the next makes up for."""
    observer = GroundTruthReader(scene, truth.row)
    period, owner = pace * TICK, os.getppid()
    tick, due = 0, time.monotonic()
    counters.start(due)
    while tick % _LOOK or os.getppid() == owner:
        due += period
        wait = due - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        begun = time.monotonic()
        if begun - due > _CATCH_UP * period:
            missed = int((begun - due) / period)
            counters.drop(missed)
            due += missed * period
        for end in ends:
            end.process_commands()
        orders.carry_out(scene.place_block)
        scene.step()
        for end in ends:
            end.send_state()
        observer.fill(tick, time.monotonic() / pace)
        truth.publish(tick)
        tick += 1
        done = time.monotonic()
        counters.count(tick, done, done - begun, begun - due)


if __name__ == "__main__":
    main()
