"""A robot that stops by itself: its reason is the one that is told."""

import numpy as np

from contactgraph_franka.safety import Command, FakeRobot, SafeRobot, SafetyLimits, Stop, StopReason

PUSH = np.array([0.0, 5.0, 0.0])


def test_a_robot_that_stops_by_itself_says_why() -> None:
    robot = FakeRobot()
    safe = SafeRobot(robot, SafetyLimits(), robot.clock)
    for tick in range(60):
        if tick == 30:
            robot.ended = Stop(StopReason.ARM_STOPPED, robot.clock())
        safe.read()
        sent = safe.send(Command(PUSH, robot.clock()))
        assert (sent is None) == (tick >= 30)
        robot.advance()
    assert safe.stop is not None
    assert safe.stop.reason is StopReason.ARM_STOPPED
    assert safe.stop.time == 30 * 0.001
    assert "a reflex" in str(safe.stop)
    safe.reset()
    safe.read()
    assert safe.send(Command(PUSH, robot.clock())) is not None
