"""Dynamics, readings and faults of the fake robot, and stops of `SafeRobot`."""

from collections.abc import Callable

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import PickupTask
from contactgraph_franka.safety import (
    FAULTS,
    Command,
    FakeRobot,
    Fault,
    RobotReading,
    SafeRobot,
    SafetyLimits,
    Stop,
    StopReason,
)
from contactgraph_franka.safety.faults import lost_packet_fault, nan_fault


def driven(robot: FakeRobot, force: np.ndarray, cycles: int) -> None:
    for _ in range(cycles):
        robot.send(force, robot.clock())
        robot.advance()


def test_contact_is_inelastic_and_lasts() -> None:
    robot = FakeRobot()
    robot.velocity[0] = (robot.position[1] - robot.position[0]) / 0.2
    before = 4.0 * robot.velocity.copy()[0]
    driven(robot, np.zeros(3), 300)
    assert robot.holding
    np.testing.assert_allclose(4.0 * robot.velocity[0] + 0.4 * robot.velocity[1], before)
    np.testing.assert_allclose(robot.velocity[1], robot.velocity[0])
    assert robot.read().contact[0, 1] == 1


@pytest.mark.parametrize("kind", FAULTS)
def test_fault_is_present_in_its_cycles_only(kind: Callable[[int, int], Fault]) -> None:
    faulty, sound = FakeRobot(0, [kind(2, 4)]), FakeRobot(0)
    for cycle in range(6):
        read, true = faulty.read(), sound.read()
        same = read is not None and all(
            np.array_equal(getattr(read, name), getattr(true, name))
            for name in ("position", "time", "robot_time", "tracked")
        )
        # A frozen reading is the true one in its first cycle.
        if cycle != 2:
            assert (same and not faulty.late) == (cycle != 3)
        faulty.advance()
        sound.advance()


def test_robot_without_commands_brakes() -> None:
    robot = FakeRobot()
    driven(robot, np.array([10.0, 0.0, 0.0]), 50)
    speed = robot.velocity[0, 0]
    for _ in range(100):
        robot.advance()
    assert robot.braking and robot.velocity[0, 0] < 0.05 * speed


def pushed(robot: FakeRobot, safe: SafeRobot) -> bool:
    """Whether a force along y arrives in a cycle."""
    safe.read()
    sent = safe.send(Command(np.array([0.0, 5.0, 0.0]), robot.clock()))
    robot.advance()
    return sent is not None


def test_stop_is_repeated_until_it_arrives() -> None:
    robot = FakeRobot(0, [lost_packet_fault(20, 60)])
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for cycle in range(70):
        assert pushed(robot, safe) == (cycle < 20)
        assert (robot.stopped is None) == (cycle < 60)
    assert robot.stopped is safe.stop and safe.stop.reason is StopReason.CONNECTION_LOST


def test_only_reset_moves_a_stopped_robot() -> None:
    robot = FakeRobot(0, [nan_fault(20, 30)])
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for cycle in range(120):
        if cycle == 100:
            assert robot.braking
            safe.reset()
        assert pushed(robot, safe) == (not 24 <= cycle < 100)
    assert safe.stop is None and robot.velocity[0, 1] > 0.0


def test_observation_of_a_reading() -> None:
    reading = FakeRobot().read()
    observation = reading.observation(np.zeros(3))
    assert set(observation) == set(PickupTask().observation_space.spaces)
    assert observation["contact"][0, 1] == 0.0
    blind = RobotReading(
        reading.position, reading.velocity, reading.time, 0.0, reading.tracked
    ).observation(np.zeros(3))
    assert blind["contact"].shape == (2, 2) and np.isnan(blind["contact"]).all()


def test_shapes_of_a_reading() -> None:
    with pytest.raises(InvalidInputError, match=r"time must be \[2\], found \(3,\)"):
        RobotReading(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(3), 0.0, np.ones(2))
    with pytest.raises(InvalidInputError, match=r"position must be \[N, D\], found \(3,\)"):
        RobotReading(np.zeros(3), np.zeros(3), np.zeros(1), 0.0, np.ones(1))


def test_stop_by_the_robot_itself_keeps_its_reason() -> None:
    robot = FakeRobot()
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for cycle in range(60):
        if cycle == 30:
            robot.ended = Stop(StopReason.ARM_STOPPED, robot.clock())
        assert pushed(robot, safe) == (cycle < 30)
    assert safe.stop == Stop(StopReason.ARM_STOPPED, 30 * 0.001)
    safe.reset()
    assert pushed(robot, safe)
