"""A look through a camera, before anything moves."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.cli.options import FAKE, ArmOptions, RobotFault
from contactgraph_franka.driver.readings import AssumedBlock
from contactgraph_franka.envs.pickup import ArmLayout
from contactgraph_franka.loop import WallClock
from contactgraph_franka.perception import Camera, CameraCalibration
from contactgraph_franka.perception.detector import ObjectDetector, PoseEstimate
from contactgraph_franka.perception.tracked_objects import TrackedObjects
from contactgraph_franka.safety import FakeRobot, Robot, SafetyLimits, Stop
from contactgraph_franka.safety.fake_robot import RealtimeFakeRobot

_LOOK_S = 15.0
"""Wall seconds: rehearsed cameras are slow."""


def glimpsed(
    open_camera: Callable[[], Camera], calibration: CameraCalibration, name: str
) -> PoseEstimate:
    """The object of this name, in the first frame that shows it.

    Raises `RobotFault` where none does.
    """
    camera = open_camera()
    try:
        sight, until = ObjectDetector(calibration), time.monotonic() + _LOOK_S
        while time.monotonic() < until:
            frame = camera.read()
            seen = {} if frame is None else sight.detect(frame)
            if name in seen:
                return seen[name]
            time.sleep(0.01)
    finally:
        camera.close()
    raise RobotFault(
        f"the camera does not see the {name}: is it in the picture, lit, its tags towards the "
        "camera, and the calibration this camera's?"
    )


def glimpsed_yaw(
    open_camera: Callable[[], Camera], calibration: CameraCalibration, name: str
) -> float:
    """rad: how the object is turned about the vertical. Raises as `glimpsed`."""
    turn = glimpsed(open_camera, calibration, name).pose[:3, :3]
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


if TYPE_CHECKING:
    from contactgraph_franka.driver.franka_robot import FrankaRobot
    from contactgraph_franka.driver.gripper import FrankaGripper
    from contactgraph_franka.sim.simulated_robot import SimulatedRobot

_FAKE_HAND, _FAKE_BLOCK = (0.5, -0.2, 0.25), (0.5, 0.05, 0.1)
"""m: where they are at first."""
_SLOWLY = 0.2
"""Of the arm's own speed, where it moves by itself."""
_NODES = ("block",)
"""After the hand."""


class Arm(Protocol):
    """An arm, and what else a person does with it than to push it about."""

    robot: Robot
    clock: WallClock
    words: str
    """What it is."""
    real: bool
    """Whether somebody could get hurt."""
    seen: TrackedObjects | None
    """What its camera sees; None without one."""
    assumed: AssumedBlock | None
    """The block that nobody sees; None where somebody does."""

    block_yaw: float
    """rad: how the block was turned when the arm was open_arm; 0 where nobody saw it."""

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """Names and words."""

    def move_to(self, position: np.ndarray, yaw: float) -> None:
        """Moves the open hand slowly to ``position`` [3] m; raises `RobotFault` where it cannot."""

    def arrange(self, layout: ArmLayout) -> bool:
        """Puts the block where ``layout`` has it; False where a person must do it."""

    def said(self) -> str:
        """What the arm itself said of its last end; empty where it said nothing."""


class FakeArm:
    """`FakeRobot` in real time."""

    real = False
    block_yaw = 0.0
    seen: TrackedObjects | None = None
    assumed: AssumedBlock | None = None
    words = "a fake arm: a point mass and an object without weight"

    def __init__(self) -> None:
        self.clock = WallClock()
        self._fake = FakeRobot()
        self._fake.place(np.array(_FAKE_HAND), np.array(_FAKE_BLOCK))
        self.robot: Robot = RealtimeFakeRobot(self._fake, self.clock)

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """See `Arm`."""
        low, high = limits.workspace_low, limits.workspace_high
        return [
            ("address", FAKE),
            ("force", f"at most {limits.max_force:g} N, changing by {limits.max_force_rate:g} N/s"),
            ("workspace", f"{low} to {high} m"),
            ("stop", f"within {1e3 * limits.stop_within:g} ms of a fault"),
        ]

    def move_to(self, position: np.ndarray, yaw: float) -> None:
        """See `Arm`; it is there at once."""
        self._fake.place(position, self._fake.position[1])

    def arrange(self, layout: ArmLayout) -> bool:
        """See `Arm`."""
        self._fake.place(self._fake.position[0], layout.blocks[0])
        return True

    def said(self) -> str:
        """See `Arm`."""
        return ""


class FrankaArm:
    """An arm of Franka's, with its gripper."""

    def __init__(
        self,
        robot: "FrankaRobot",
        gripper: "FrankaGripper",
        clock: WallClock,
        rehearsal: "SimulatedRobot | None",
        seen: TrackedObjects | None,
        assumed: AssumedBlock | None,
        block_yaw: float,
    ) -> None:
        self.robot: Robot = robot
        self.block_yaw = block_yaw
        self.clock, self.seen, self.assumed = clock, seen, assumed
        self.real = rehearsal is None
        self.words = f"the arm at {robot.address}"
        if rehearsal is not None:
            self.words = f"the rehearsed arm at {robot.address}, {rehearsal.pace:g} times slower"
        self._franka, self._gripper, self._rehearsal = robot, gripper, rehearsal

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """See `Arm`."""
        from contactgraph_franka.driver.description import describe_gripper

        fingers = self._gripper
        return [
            *self._franka.describe(limits),
            *describe_gripper(fingers.width, fingers.largest_width, fingers.version),
        ]

    def move_to(self, position: np.ndarray, yaw: float) -> None:
        """See `Arm`."""
        self._gripper.open()
        if self._franka.ended is not None and not self._franka.recover():
            raise RobotFault(f"{self.words} does not recover: {self._franka.last_error}")
        ended = self._franka.move_to(position, yaw, speed=_SLOWLY if self.real else 0.5)
        if ended is not None:
            raise RobotFault(f"{self.words} {ended}; it said: {self.said()}")

    def arrange(self, layout: ArmLayout) -> bool:
        """See `Arm`."""
        if self._rehearsal is None:
            return False
        self._rehearsal.place_block(0, layout.blocks[0], float(layout.block_yaw[0]))
        return True

    def said(self) -> str:
        """See `Arm`."""
        ended: Stop | None = self._franka.ended
        words = "" if ended is None else ended.reason.value
        return " ".join(f"{words} {self._franka.last_error}".split())


@contextmanager
def open_arm(address: str, options: ArmOptions) -> Iterator[Arm]:
    """The arm at ``address``, with whoever sees its block; nothing moves.

    Raises `InvalidInputError` where there is none, or what it needs is not there.
    """
    if address == FAKE:
        if options.camera != "none" or options.block is not None:
            raise InvalidInputError("the fake arm sees for itself: leave --camera and --block out")
        yield FakeArm()
        return
    from contactgraph_franka.driver.franka_robot import FrankaRobot
    from contactgraph_franka.driver.gripper import FrankaGripper

    rehearsal = _rehearsal(address)
    clock = WallClock() if rehearsal is None else rehearsal.clock
    with ExitStack() as stack:
        seen, assumed, yaw = _objects(address, options, clock, rehearsal, stack)
        gripper = stack.enter_context(FrankaGripper(address, clock))
        robot = FrankaRobot(
            address,
            seen or assumed,
            clock,
            fingers=gripper,
        )
        stack.enter_context(robot)
        yield FrankaArm(robot, gripper, clock, rehearsal, seen, assumed, yaw)


def _rehearsal(address: str) -> "SimulatedRobot | None":
    """The one that runs at ``address``, if one does."""
    from contactgraph_franka.sim.simulated_robot import attach

    try:
        return attach(address)
    except InvalidInputError:
        return None


def _objects(
    address: str,
    options: ArmOptions,
    clock: WallClock,
    rehearsal: "SimulatedRobot | None",
    stack: ExitStack,
) -> tuple[TrackedObjects | None, AssumedBlock | None, float]:
    """Who tells where the block is, a camera or the user; and how it is turned, rad."""
    from contactgraph.cli.options import choice

    choice("--camera", options.camera, dict.fromkeys(("none", "realsense", "rendered")))
    if options.camera == "none":
        if options.block is None:
            raise InvalidInputError("without a --camera, --block X Y Z must say where the block is")
        return None, AssumedBlock(np.array(options.block, dtype=float)), 0.0
    if options.block is not None:
        raise InvalidInputError("--block: the camera sees it, so one of the two must be left out")
    from contactgraph_franka.cli.arms import glimpsed_yaw
    from contactgraph_franka.perception import Camera, read_calibration
    from contactgraph_franka.perception.perception import Perception

    open_eye: Callable[[], Camera]
    told = None if options.calibration is None else read_calibration(options.calibration)
    if options.camera == "rendered":
        from contactgraph_franka.sim.simulated_robot import open_camera

        if rehearsal is None:
            raise InvalidInputError(
                f"--camera rendered: no rehearsal runs at {address}; an arm has a realsense"
            )
        told = rehearsal.calibration() if told is None else told
        open_eye = partial(open_camera, address)
    else:
        from contactgraph_franka.perception.realsense import RealSenseCamera

        if told is None:
            raise InvalidInputError(
                "--camera realsense needs --calibration FILE, as `contactgraph robot calibrate` "
                "writes it"
            )
        open_eye = RealSenseCamera
    missing = [name for name in _NODES if name not in told.objects]
    if missing:
        raise InvalidInputError(
            f"the calibration knows {', '.join(told.objects) or 'no objects'}; it must know block"
        )
    yaw = glimpsed_yaw(open_eye, told, *_NODES)
    perception = stack.enter_context(Perception(open_eye, told, clock))
    return TrackedObjects(perception, _NODES), None, yaw
