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


def test_hand_accelerates_as_its_mass() -> None:
    robot = FakeRobot()
    start = robot.position[0].copy()
    driven(robot, np.array([2.0, 0.0, 0.0]), 100)
    np.testing.assert_allclose(robot.velocity[0], [0.05, 0.0, 0.0], rtol=1e-9)
    np.testing.assert_allclose(robot.position[0] - start, [0.0025, 0.0, 0.0], atol=1e-12)


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
def test_readings_are_reproducible(kind: Callable[[int, int], Fault]) -> None:
    first, second, other = FakeRobot(3, [kind(2, 6)]), FakeRobot(3, [kind(2, 6)]), FakeRobot(4)
    for _ in range(8):
        a, b, c = first.read(), second.read(), other.read()
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a.position, b.position)
            assert not np.array_equal(a.position, c.position)
        for robot in (first, second, other):
            driven(robot, np.ones(3), 1)


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


def test_stop_is_repeated_until_it_arrives() -> None:
    robot = FakeRobot(0, [lost_packet_fault(20, 60)])
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for cycle in range(70):
        safe.read()
        sent = safe.send(Command(np.array([0.0, 5.0, 0.0]), robot.clock()))
        assert (sent is None) == (cycle >= 20)
        assert (robot.stopped is None) == (cycle < 60)
        robot.advance()
    assert robot.stopped is safe.stop and safe.stop.reason is StopReason.CONNECTION_LOST


def test_only_reset_moves_a_stopped_robot() -> None:
    robot = FakeRobot(0, [nan_fault(20, 30)])
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for cycle in range(120):
        if cycle == 100:
            assert robot.braking
            safe.reset()
        safe.read()
        sent = safe.send(Command(np.array([0.0, 5.0, 0.0]), robot.clock()))
        assert (sent is None) == (24 <= cycle < 100)
        robot.advance()
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
        safe.read()
        sent = safe.send(Command(np.array([0.0, 5.0, 0.0]), robot.clock()))
        assert (sent is None) == (cycle >= 30)
        robot.advance()
    assert safe.stop is not None
    assert safe.stop.reason is StopReason.ARM_STOPPED
    assert safe.stop.time == 30 * 0.001
    assert "a reflex" in str(safe.stop)
    safe.reset()
    safe.read()
    assert safe.send(Command(np.array([0.0, 5.0, 0.0]), robot.clock())) is not None
