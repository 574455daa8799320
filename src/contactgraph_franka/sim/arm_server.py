"""The simulated arm over a table with tagged blocks, served by the arm's own protocol.

No other module imports franky_sim.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.arm_model import JOINTS, mujoco
from contactgraph_franka.loop.realtime import realtime_priority
from contactgraph_franka.sim.blocks import CONTACT, MASS, WOOD_FRICTION, scene_blocks
from contactgraph_franka.sim.session import Session
from contactgraph_franka.sim.shared_state import SceneResetService, create_ground_truth

try:
    from franky_sim import RobotParameters, SimulationServer
    from franky_sim.mujoco_simulator import MujocoSimulator
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "a simulated robot needs franky-sim: pip install 'contactgraph[rehearsal]'"
    ) from error

CONTROL_PERIOD = 0.001
"""s, of the arm's controller."""
START = (0.0, -0.2849, 0.0, -2.3967, 0.0, 2.1118, np.pi / 4)
"""rad: the grasp point at (0.45, 0, 0.3) m, the hand pointing down."""
GRASP_POINT = (0.0, 0.0, 0.1254)
"""Centre of a grasped block in the hand's frame, m: 22 mm beyond the middle of the pads, where a
block 0.1 m high does not meet the palm."""
_STIFFNESS = (600.0, 600.0, 400.0, 400.0, 50.0, 50.0, 20.0)
"""N m/rad, of the arm's joint controller, which holds it while no torques are commanded."""
_DAMPING = (25.0, 40.0, 20.0, 20.0, 1.0, 1.0, 0.2)
"""N m s/rad. More than the joint's inertia over a control step is unstable."""
_SPINDLE = "2"
"""Apparent mass of a finger's drive, kg. With franky-sim's 0.2 the speed controller overshoots, and
fingers close twice as fast as commanded."""
_SKIN_FRICTION = ".6 .01 .0001"  # Friction of pads on a block, as in the arm's task
# The hand's own mass, without the two fingers of 0.015 kg that MuJoCo's model adds. Its frame is
# turned by an eighth against the flange's, in which the load is declared.
_FINGERS = 0.03
_HAND = 0.73
_HAND_CENTRE = (-0.01, 0.0, 0.03)
_FINGERS_CENTRE = (0.0, 0.0, 0.0584)
_HAND_INERTIA = (0.001, 0.0025, 0.0017)
_CATCH_UP = 10  # Steps behind time that are caught up with; more are dropped
_OWNER_CHECK = 100  # Steps between checks that the owner lives


class ArmScene:
    """franky-sim's arm with a table at z = 0 and ``blocks`` tagged blocks. A context manager.

    It differs from franky-sim's own scene: joints have neither friction nor motor inertia, since a
    real arm's commanded torques are "without gravity and friction" (libfranka's `Torques`); the
    holding controller is soft enough for that; fingers keep to the commanded speed; links collide
    with nothing, the hand with blocks and table; contacts are those of `envs/panda.xml`.

    Raises `InvalidInputError` for a count without tags.
    """

    def __init__(self, blocks: int = 1, mass: float = MASS) -> None:
        self.blocks = scene_blocks(blocks, mass)
        """Nodes 1 and on; node 0 is the hand."""
        self._simulator = MujocoSimulator()

    def __enter__(self) -> "ArmScene":
        self._simulator.init()
        self.robot = self._simulator.add_robot(
            initial_q=START, robot_parameters=_hand_parameters(), kp=_STIFFNESS, kv=_DAMPING
        )
        """franky-sim's own, for its torques and fingers."""
        scene = self._simulator.scene
        _edit_scene(scene)
        for block in self.blocks:
            block.append_to(scene)
        self.description = ElementTree.tostring(scene, encoding="unicode")
        """The MJCF, for a renderer's copy."""
        return self

    def __exit__(self, *_: object) -> None:
        self._simulator.cleanup()

    @property
    def model(self) -> mujoco.MjModel:
        """Available after `start` or `server`."""
        return self._simulator.model

    @property
    def data(self) -> mujoco.MjData:
        """Available after `start` or `server`."""
        return self._simulator.data

    def start(self) -> None:
        """Prepares for `step` without a server."""
        self._simulator.start()

    @contextmanager
    def server(self, address: str) -> Iterator[list[Any]]:
        """Serves the arm's protocol at ``address``.

        Yields franky-sim's servers: `process_commands` before every `step`, `send_state` after it.
        """
        with SimulationServer(self._simulator, hostname_candidates=[address]) as server:
            yield server.robot_servers

    def step(self) -> None:
        """Advances by a control step under the last torques."""
        self._simulator.step()

    def place_block(self, index: int, position: np.ndarray, yaw: float) -> None:
        """Moves block ``index`` to ``position`` [3] m and ``yaw`` rad, at rest."""
        qpos = self.data.qpos[JOINTS + 2 + 7 * index :][:7]
        qpos[:3] = position
        qpos[3:] = np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)
        self.data.qvel[JOINTS + 2 + 6 * index :][:6] = 0.0
        # The contact forces of the old position must not start the next solve.
        self.data.qacc_warmstart[:] = 0.0
        mujoco.mj_forward(self.model, self.data)


class StateRecorder:
    """Records the present state of ``scene`` in the fields of `ground_truth_fields`."""

    def __init__(self, scene: ArmScene) -> None:
        model, data = scene.model, scene.data
        self._model, self._data = model, data
        count, first = len(scene.blocks), JOINTS + 2
        self._site = model.site("grasp").id
        self._twist, self._quaternion = np.zeros(6), np.zeros(4)
        self._hand_position = data.site_xpos[self._site]
        self._hand_frame = data.site_xmat[self._site]
        self._block_poses = data.qpos[first:].reshape(count, 7)
        self._block_velocities = data.qvel[first:].reshape(count, 6)
        self._fingers = data.qpos[JOINTS:first]
        # The column of each shape that a block may touch: left finger, right finger, table.
        columns = {
            model.geom(f"{side}_pad{number}").id: column
            for column, side in enumerate(("left", "right"))
            for number in range(1, 6)
        }
        columns[model.geom("ground").id] = 2
        self._touch_index: dict[tuple[int, int], tuple[int, int]] = {}
        for block in range(count):
            geom = model.geom(f"block{block}").id
            for other, column in columns.items():
                self._touch_index[geom, other] = self._touch_index[other, geom] = block, column
        self._touch = np.zeros((count, 3), bool)

    def fill(self, row: np.void, number: int, stamp: float) -> None:
        """Fills ``row`` with the state after step ``number``, ``stamp`` s on the reader's clock."""
        model, data = self._model, self._data
        # After a step, derived quantities are still those of its beginning.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, self._twist, 0)
        mujoco.mju_mat2Quat(self._quaternion, self._hand_frame)
        self._touch[:] = False
        for pair in data.contact.geom.tolist():
            index = self._touch_index.get((pair[0], pair[1]))
            if index is not None:
                self._touch[index] = True
        position, velocity, turn = row["position"], row["velocity"], row["turn"]
        row["time"], row["stamp"] = (number + 1) * CONTROL_PERIOD, stamp
        position[0], position[1:] = self._hand_position, self._block_poses[:, :3]
        velocity[0], velocity[1:] = self._twist[3:], self._block_velocities[:, :3]
        turn[0], turn[1:] = self._quaternion, self._block_poses[:, 3:]
        row["fingers"], row["standing"] = self._touch[:, :2], self._touch[:, 2]
        row["width"] = self._fingers[0] + self._fingers[1]
        row["qpos"] = data.qpos


def serve(connection: Connection, session: Session) -> None:
    """Serves until the other end of ``connection`` closes; sends None after the first step."""
    with ArmScene(session.blocks, session.mass) as scene:
        (session.folder / "scene.xml").write_text(scene.description)
        with scene.server(session.address) as servers, realtime_priority():
            _step_in_time(connection, scene, servers, session)


def _step_in_time(
    connection: Connection, scene: ArmScene, servers: list[Any], session: Session
) -> None:
    """Control steps at absolute times, so that delays do not add up."""
    pace, folder = session.pace, session.folder
    period = pace * CONTROL_PERIOD
    number, due = 0, time.monotonic()
    truth = create_ground_truth(folder, len(scene.blocks), scene.model.nq)
    recorder, resets = StateRecorder(scene), SceneResetService(folder)
    while number % _OWNER_CHECK or not connection.poll():
        due += period
        late = time.monotonic() - due
        if late < 0.0:
            time.sleep(-late)
        elif late > _CATCH_UP * period:
            due += int(late / period) * period
        for server in servers:
            server.process_commands()
        resets.execute(scene.place_block)
        scene.step()
        for server in servers:
            server.send_state()
        recorder.fill(truth.begin(), number, time.monotonic() / pace)
        truth.publish()
        if not number:
            connection.send(None)
        number += 1


def _hand_parameters() -> "RobotParameters":
    """The exact load of the hand and its fingers, which the arm compensates."""
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


def _edit_scene(scene: ElementTree.Element) -> None:
    """The differences from franky-sim's own scene, see `ArmScene`."""
    for joint in scene.iterfind("worldbody//joint"):
        if "fr3_joint" in joint.get("name", ""):
            joint.attrib.update(frictionloss="0", armature="0", damping="0")
        elif "finger_joint" in joint.get("name", ""):
            joint.attrib.update(armature=_SPINDLE)
    _element(scene, "option").attrib.update(cone="elliptic", impratio="10")
    hand = _element(scene, "worldbody//body[@name='robot0_hand']")
    position = " ".join(str(number) for number in GRASP_POINT)
    ElementTree.SubElement(hand, "site", name="grasp", pos=position)
    skin = _element(scene, "default//default[@class='collision']/geom")
    skin.attrib.update(CONTACT, friction=_SKIN_FRICTION)
    ground = _element(scene, "worldbody/geom[@name='ground']")
    ground.attrib.update(CONTACT, friction=WOOD_FRICTION)
    for geom in scene.iterfind("worldbody//geom[@mesh]"):
        if "fr3_link" in geom.get("name", ""):
            geom.attrib.update(contype="0", conaffinity="0")
    for side in ("left", "right"):
        finger = _element(scene, f"worldbody//body[@name='robot0_{side}_finger']")
        for geom in finger.iterfind("geom[@class]"):
            kind = geom.get("class", "")
            if kind.startswith("fingertip_pad"):
                geom.set("name", f"{side}_pad{kind[-1]}")


def _element(scene: ElementTree.Element, path: str) -> ElementTree.Element:
    element = scene.find(path)
    if element is None:
        raise InvalidInputError(f"franky-sim's scene has no {path}: another version than 1.0?")
    return element
