"""Driver and gripper over stubs of the maker's client: readings, forces, stops and faults."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")

from contactgraph.data import InvalidInputError
from contactgraph_franka.driver.client import franky
from contactgraph_franka.driver.franka_robot import FrankaRobot
from contactgraph_franka.driver.gripper import FrankaGripper
from contactgraph_franka.driver.readings import AssumedBlock
from contactgraph_franka.safety import SafetyLimits, Stop, StopReason

HAND = np.array([0.5, 0.0, 0.3])
BLOCK = np.array([0.5, 0.1, 0.05])
VELOCITY = np.linspace(0.1, 0.7, 7)
JACOBIAN = np.vstack([np.eye(6), np.zeros(6)]).T + 0.1
FORCE = np.array([0.0, 0.001, 0.0])
ASKED = Stop(StopReason.ASKED, 0.0)


class StubMotion:
    def __init__(self, **options: Any) -> None:
        self.options = options
        self.torque: np.ndarray | None = None

    def set_torque(self, torque: np.ndarray) -> None:
        self.torque = torque


class StubArm:
    """An arm whose state is new in each ``cycle``; ``error`` ends its motion, ``lost`` all."""

    def __init__(self) -> None:
        self.cycle, self.is_in_control = 0, False
        self.error: Exception | None = None
        self.lost: Exception | None = None
        self.velocity, self.planner_failures = VELOCITY, 0
        self.motions: list[Any] = []
        self.model = SimpleNamespace(
            pose=lambda *_: SimpleNamespace(translation=HAND),
            mass=lambda _: np.eye(7),
            coriolis=lambda _: np.zeros(7),
            zero_jacobian=lambda *_: JACOBIAN,
        )

    @property
    def state(self) -> SimpleNamespace:
        if self.lost is not None:
            raise self.lost
        return SimpleNamespace(
            time=SimpleNamespace(to_msec=lambda: self.cycle),
            q=np.zeros(7),
            dq=self.velocity,
            tau_J_d=np.zeros(7),
            O_T_EE=SimpleNamespace(quaternion=np.array([1.0, 0.0, 0.0, 0.0]), matrix=np.eye(4)),
            F_T_EE=franky.Affine(),
            EE_T_K=franky.Affine(),
        )

    def set_collision_behavior(self, *thresholds: float) -> None:
        self.thresholds = thresholds

    def move(self, motion: Any, **options: Any) -> None:
        self.planner_failures -= 1
        if self.planner_failures >= 0:
            raise RuntimeError("Motion planner failed with error code -111")
        self.motions.append(motion)
        self.is_in_control = True

    def join_motion(self, timeout: float) -> None:
        if self.error is not None:
            error, self.error = self.error, None
            raise error

    def recover_from_errors(self) -> bool:
        return True


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> StubArm:
    stub = StubArm()
    module = "contactgraph_franka.driver.franka_robot"
    monkeypatch.setattr(f"{module}.connect", lambda address: stub)
    monkeypatch.setattr(f"{module}.franky.SimpleTorqueMotion", StubMotion)
    return stub


def test_each_state_is_read_once(arm: StubArm) -> None:
    robot = FrankaRobot("arm", clock=lambda: 7.0)
    assert arm.thresholds == (20.0, 30.0)
    reading = robot.read()
    assert reading is not None and reading.contact is None and reading.time[0] == 7.0
    np.testing.assert_array_equal(reading.position, [HAND])
    np.testing.assert_allclose(reading.velocity[0], JACOBIAN[:3] @ VELOCITY)
    assert robot.read() is None
    arm.cycle = 1
    reading = robot.read()
    assert reading is not None and reading.robot_time == 0.001


def test_forces_become_torques_until_a_stop(arm: StubArm) -> None:
    robot = FrankaRobot("arm")
    assert robot.send(FORCE, 0.0) is None and not robot.moving
    robot.resume()
    robot.read()
    assert robot.moving
    sent = robot.send(FORCE, 0.0)
    # The limit of the torques' rate shortens the first forces in their direction.
    assert sent is not None and 0.0 < sent[1] <= FORCE[1] and not sent[[0, 2]].any()
    (motion,) = arm.motions
    assert motion.torque.shape == (7,) and motion.options["signal_timeout"] == 0.02
    motion.torque = None
    assert robot.send(np.full(3, np.nan), 0.0) is None and motion.torque is None
    with pytest.raises(InvalidInputError, match="stop it before move_to"):
        robot.move_to(HAND)
    robot.stop(ASKED)
    assert isinstance(arm.motions[1], franky.TorqueStopMotion)
    assert robot.send(FORCE, 0.0) is None and robot.ended is None
    robot.stop(ASKED)
    assert len(arm.motions) == 2


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (franky.ControlException("reflex"), StopReason.ARM_STOPPED),
        (franky.CommandException("guided"), StopReason.ARM_STOPPED),
        (franky.TorqueSignalTimeoutException("silence"), StopReason.COMMAND_LATE),
        (RuntimeError("libfranka: UDP receive"), StopReason.CONNECTION_LOST),
    ],
)
def test_end_of_a_motion_is_reported(arm: StubArm, error: Exception, reason: StopReason) -> None:
    robot = FrankaRobot("arm", clock=lambda: 3.0)
    robot.resume()
    robot.read()
    arm.error, arm.is_in_control = error, False
    assert robot.send(FORCE, 0.0) is None
    assert robot.ended == Stop(reason, 3.0) and robot.last_error == str(error)
    assert robot.recover() and robot.ended is None
    robot.resume()
    assert robot.moving


def test_lost_connection_is_no_exception(arm: StubArm) -> None:
    robot = FrankaRobot("arm")
    np.testing.assert_array_equal(robot.hand_pose(), np.eye(4))
    arm.lost = RuntimeError("no route")
    assert robot.read() is None
    assert robot.ended is not None and robot.ended.reason is StopReason.CONNECTION_LOST
    lines = dict(robot.describe(SafetyLimits()))
    assert lines["connection"] == "lost: no route" and lines["force"].startswith("at most 20 N")
    with pytest.raises(InvalidInputError, match="the arm at arm is lost: no route"):
        robot.hand_pose()


class StubFingers:
    block = 0

    def __init__(self) -> None:
        self.offsets: list[np.ndarray] = []

    def follow(self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray) -> None:
        self.offsets.append(offset)

    def contact(self) -> float:
        return 1.0


def test_fingers_move_while_forces_act_and_carry_the_block(arm: StubArm) -> None:
    fingers = StubFingers()
    robot = FrankaRobot("arm", AssumedBlock(BLOCK), fingers=fingers)
    reading = robot.read()
    assert reading is not None and reading.contact is not None and not fingers.offsets
    np.testing.assert_array_equal(reading.contact, [[0.0, 1.0], [1.0, 0.0]])
    # The fingers report contact, so that the block is at the hand.
    np.testing.assert_array_equal(reading.position[1], HAND)
    robot.resume()
    arm.cycle = 1
    robot.read()
    np.testing.assert_array_equal(fingers.offsets, [np.zeros((1, 3))])


class LostGripper:
    """Fingers that close by 4 mm a read on a block of 0.04 m, until the gripper is lost."""

    server_version, width, target, lost = 3, 0.06, 0.06, False

    @property
    def state(self) -> SimpleNamespace:
        if self.lost:
            raise RuntimeError("gripper gone")
        self.width = max(self.width - 0.004, self.target)
        return SimpleNamespace(width=self.width, max_width=0.08)

    def move_async(self, width: float, speed: float) -> Any:
        return SimpleNamespace(wait=lambda timeout: True)

    def grasp_async(self, width: float, speed: float, force: float, **options: float) -> Any:
        self.target = 0.04
        return SimpleNamespace(wait=lambda timeout: False)


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_lost_gripper_reports_no_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    stub = LostGripper()
    monkeypatch.setattr("contactgraph_franka.driver.gripper.connect_gripper", lambda address: stub)
    with FrankaGripper("arm") as gripper:
        gripper.follow(np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1, bool))
        wait_for(lambda: gripper.contact() == 1.0)
        stub.lost = True
        wait_for(lambda: gripper.last_error == "gripper gone")
        gripper._thread.join(2.0)
        assert np.isnan(gripper.contact())
        gripper.open()


@pytest.mark.parametrize(("failures", "moved"), [(0, 1), (2, 1), (3, 0)])
def test_motion_planner_is_called_again_after_a_failure(
    arm: StubArm, failures: int, moved: int
) -> None:
    arm.velocity, arm.planner_failures = np.zeros(7), failures
    stop = FrankaRobot("arm").move_to(HAND)
    assert len(arm.motions) == moved
    assert (stop is None) if moved else (stop.reason is StopReason.ARM_STOPPED)


@pytest.mark.parametrize(
    ("position", "speed", "text"),
    [
        ([0.5, 0.1], 0.1, r"position must be \[3\] m, and yaw rad, found \[0.5, 0.1\]"),
        ([0.5, 0.1, np.nan], 0.1, r"position must be \[3\] m"),
        (HAND, 0.0, "speed must be above 0 and at most 1, found 0.0"),
    ],
)
def test_invalid_targets(arm: StubArm, position: Any, speed: float, text: str) -> None:
    with pytest.raises(InvalidInputError, match=text):
        FrankaRobot("arm").move_to(position, speed=speed)


@pytest.mark.parametrize("address", ["127.0.0.99", "no-such-arm.invalid"])
def test_no_arm_at_an_address(address: str) -> None:
    with pytest.raises(InvalidInputError, match=f"no arm answers at {address}: .* FCI") as caught:
        FrankaRobot(address)
    assert "\n" not in str(caught.value)
