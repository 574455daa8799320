"""Arms by their addresses: real, simulated behind the real protocol, or fake."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import choice
from contactgraph_franka.cli.options import FAKE, NO_BLOCK, ArmOptions, RobotFault
from contactgraph_franka.driver.readings import AssumedBlock
from contactgraph_franka.envs.pickup import ArmLayout
from contactgraph_franka.loop import WallClock
from contactgraph_franka.perception import Camera, CameraCalibration, CameraFrame, read_calibration
from contactgraph_franka.safety import FakeRobot, Robot, SafetyLimits
from contactgraph_franka.safety.fake_robot import RealtimeFakeRobot

if TYPE_CHECKING:
    from contactgraph_franka.driver.franka_robot import FrankaRobot
    from contactgraph_franka.driver.gripper import FrankaGripper
    from contactgraph_franka.perception.tracked_objects import TrackedObjects
    from contactgraph_franka.sim.simulated_robot import SimulatedRobot

_FAKE_HAND, _FAKE_BLOCK = (0.5, -0.2, 0.25), (0.5, 0.05, 0.1)
"""m: the first positions."""
_REAL_SPEED, _SIMULATED_SPEED = 0.2, 0.5
"""Shares of the arm's own limits, for its position control."""
_BLOCK = "block"
"""Name of the node after the hand."""
_DETECTION_TIMEOUT = 15.0
"""Wall seconds: rendered cameras are slow."""


class FakeArm:
    """`FakeRobot` in real time; the methods are those of `FrankaArm`."""

    real = False
    block_yaw = 0.0
    objects = None
    name = "a fake arm: a point mass and an object without weight"

    def __init__(self) -> None:
        self.clock = WallClock()
        self._fake = FakeRobot()
        self._fake.place(np.array(_FAKE_HAND), np.array(_FAKE_BLOCK))
        self.robot: Robot = RealtimeFakeRobot(self._fake, self.clock)

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """See `FrankaArm`."""
        low, high = limits.workspace_low, limits.workspace_high
        return [
            ("address", FAKE),
            ("force", f"at most {limits.max_force:g} N, changing by {limits.max_force_rate:g} N/s"),
            ("workspace", f"{low} to {high} m"),
            ("stop", f"within {1e3 * limits.stop_within:g} ms of a fault"),
        ]

    def move_to(self, position: np.ndarray, yaw: float) -> None:
        """See `FrankaArm`; it takes no time."""
        self._fake.place(position, self._fake.position[1])

    def place_block(self, layout: ArmLayout) -> bool:
        """See `FrankaArm`."""
        self._fake.place(self._fake.position[0], layout.blocks[0])
        return True

    def last_error(self) -> str:
        """See `FrankaArm`."""
        return ""


class FrankaArm:
    """A Franka arm with its gripper; ``simulation`` is None for a real one."""

    def __init__(
        self,
        robot: "FrankaRobot",
        gripper: "FrankaGripper",
        clock: WallClock,
        simulation: "SimulatedRobot | None",
        objects: "TrackedObjects | AssumedBlock",
        block_yaw: float,
    ) -> None:
        self.robot: Robot = robot
        self.clock = clock
        self.objects = objects
        """The source of the block's position; None where the robot has its own."""
        self.block_yaw = block_yaw
        """rad: orientation of the block when the arm was opened; 0 without a camera."""
        self.real = simulation is None
        """Whether it can hurt a person."""
        self.name = f"the arm at {robot.address}"
        """Text for the user."""
        if simulation is not None:
            self.name = f"the simulated arm at {robot.address}, {clock.pace:g} times slower"
        self._franka, self._gripper, self._simulation = robot, gripper, simulation

    def describe(self, limits: SafetyLimits) -> list[tuple[str, str]]:
        """Names and texts of its state and limits."""
        from contactgraph_franka.driver.description import describe_gripper

        fingers = self._gripper
        return [
            *self._franka.describe(limits),
            *describe_gripper(fingers.width, fingers.largest_width, fingers.version),
        ]

    def move_to(self, position: np.ndarray, yaw: float) -> None:
        """Moves the open hand slowly to ``position`` [3] m; raises `RobotFault` where it cannot."""
        self._gripper.open()
        if self._franka.ended is not None and not self._franka.recover():
            raise RobotFault(f"{self.name} does not recover: {self._franka.last_error}")
        speed = _REAL_SPEED if self.real else _SIMULATED_SPEED
        ended = self._franka.move_to(position, yaw, speed=speed)
        if ended is not None:
            raise RobotFault(f"{self.name} {ended}; its message: {self.last_error()}")

    def place_block(self, layout: ArmLayout) -> bool:
        """Puts the block to its position in ``layout``; False where a person must do it."""
        if self._simulation is None:
            return False
        self._simulation.place_block(0, layout.blocks[0], float(layout.block_yaw[0]))
        return True

    def last_error(self) -> str:
        """The arm's own message about its last stop; empty where there is none."""
        ended = self._franka.ended
        reason = "" if ended is None else ended.reason.value
        return " ".join(f"{reason} {self._franka.last_error}".split())


Arm = FakeArm | FrankaArm
"""A robot with its clock, its object source, and motions outside the control loop."""


@contextmanager
def open_arm(address: str, options: ArmOptions) -> Iterator[Arm]:
    """Connects to the arm at ``address`` and its object source; nothing moves.

    Raises `InvalidInputError` where there is none, or a part it needs is missing.
    """
    if address == FAKE:
        if options.camera != "none" or options.block is not None:
            raise InvalidInputError("the fake arm sees for itself: leave --camera and --block out")
        yield FakeArm()
        return
    from contactgraph_franka.driver.franka_robot import FrankaRobot
    from contactgraph_franka.driver.gripper import FrankaGripper

    simulation = _simulation(address)
    clock = WallClock() if simulation is None else simulation.clock
    with ExitStack() as stack:
        objects, yaw = _object_source(address, options, simulation, stack)
        gripper = stack.enter_context(FrankaGripper(address, clock))
        robot = stack.enter_context(FrankaRobot(address, objects, clock, fingers=gripper))
        yield FrankaArm(robot, gripper, clock, simulation, objects, yaw)


def _simulation(address: str) -> "SimulatedRobot | None":
    """The simulated robot at ``address``, if there is one."""
    from contactgraph_franka.sim.simulated_robot import attach

    try:
        return attach(address)
    except InvalidInputError:
        return None


def _object_source(
    address: str,
    options: ArmOptions,
    simulation: "SimulatedRobot | None",
    stack: ExitStack,
) -> "tuple[TrackedObjects | AssumedBlock, float]":
    """The source of the block's position, a camera or the user, and the block's yaw, rad."""
    choice("--camera", options.camera, dict.fromkeys(("none", "realsense", "rendered")))
    if options.camera == "none":
        if options.block is None:
            raise InvalidInputError("without a --camera, --block X Y Z must say where the block is")
        return AssumedBlock(np.array(options.block, dtype=float)), 0.0
    if options.block is not None:
        raise InvalidInputError("--block: the camera sees it, so one of the two must be left out")
    from contactgraph_franka.perception.perception import Perception
    from contactgraph_franka.perception.tracked_objects import TrackedObjects

    open_camera, calibration = _camera(address, options, simulation)
    if _BLOCK not in calibration.objects:
        known = ", ".join(calibration.objects) or "no objects"
        raise InvalidInputError(f"the calibration knows {known}; it must know {_BLOCK}")
    yaw = _block_yaw(open_camera, calibration)
    perception = stack.enter_context(Perception(open_camera, calibration))
    return TrackedObjects(perception, (_BLOCK,)), yaw


def _camera(
    address: str, options: ArmOptions, simulation: "SimulatedRobot | None"
) -> tuple[Callable[[], Camera], CameraCalibration]:
    path = options.calibration
    calibration = None if path is None else read_calibration(path)
    if options.camera == "rendered":
        from contactgraph_franka.sim.simulated_robot import open_camera

        if simulation is None:
            raise InvalidInputError(
                f"--camera rendered: no simulated robot runs at {address}; an arm has a realsense"
            )
        return partial(open_camera, address), calibration or simulation.calibration()
    from contactgraph_franka.perception.realsense import RealSenseCamera

    if calibration is None:
        raise InvalidInputError(
            "--camera realsense needs --calibration FILE, as `contactgraph robot calibrate` "
            "writes it"
        )
    return RealSenseCamera, calibration


def frames(camera: Camera, seconds: float) -> Iterator[CameraFrame]:
    """The next frames of ``camera``, for up to ``seconds`` of wall time."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        frame = camera.read()
        if frame is None:
            time.sleep(0.01)
        else:
            yield frame


def _block_yaw(open_camera: Callable[[], Camera], calibration: CameraCalibration) -> float:
    """rad: orientation of the block about the vertical, in the first frame that shows it.

    Raises `RobotFault` where none does.
    """
    from contactgraph_franka.perception.detector import ObjectDetector

    with closing(open_camera()) as camera:
        detector = ObjectDetector(calibration)
        for frame in frames(camera, _DETECTION_TIMEOUT):
            detected = detector.detect(frame)
            if _BLOCK in detected:
                rotation = detected[_BLOCK].pose[:3, :3]
                return float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    raise RobotFault(f"the camera does not see the {_BLOCK}: {NO_BLOCK}")
