"""A robot that can be reached only through its limits."""

from collections.abc import Callable

import numpy as np

from contactgraph_franka.robot.contract import Command, Robot, RobotReading
from contactgraph_franka.robot.limits import SafetyLimits
from contactgraph_franka.robot.safety_filter import SafetyFilter
from contactgraph_franka.robot.stop import Stop, StopReason


class SafeRobot:
    """What a controller holds instead of the robot: `read`, then `send`, once a tick.

    After a stop the robot is eased off, then told to brake by itself, and stays so until `reset`.
    """

    def __init__(
        self, robot: Robot, limits: SafetyLimits, clock: Callable[[], float], hand: int = 0
    ) -> None:
        """``clock`` gives the time in s in which readings and commands are stamped.

        For an arm it is `time.monotonic`. ``hand`` is the node that is driven.
        """
        self._robot = robot
        self._clock = clock
        self._filter = SafetyFilter(limits, clock(), hand)
        self._reading: RobotReading | None = None

    @property
    def stop(self) -> Stop | None:
        """Why and when the robot was stopped; None while it may move."""
        return self._filter.stop

    @property
    def believed(self) -> RobotReading | None:
        """The newest reading that the last `send` believed; None where it believed none."""
        return self._filter.believed

    def end(self, reason: StopReason) -> None:
        """Stops the robot because somebody wants it: eased off, then braked, by the next calls."""
        self._filter.halt(reason, self._clock())

    def reset(self) -> None:
        """Lets a stopped robot move again, and begins to count deadlines: call it before a loop."""
        self._robot.resume()
        self._reading = None
        self._filter.reset(self._clock())

    def read(self) -> RobotReading | None:
        """The newest reading, believed or not; None where none has come since the last call."""
        self._reading = self._robot.read()
        return self._reading

    def send(self, command: Command | None) -> np.ndarray | None:
        """Sends what the limits leave of a command, or of the last one where it is None.

        Returns the force ``[D]`` N that was really sent; None where nothing was.
        """
        now = self._clock()
        force = self._filter(command, self._reading, now)
        if self._filter.stop is not None and self._filter.eased:
            self._robot.stop(self._filter.stop)
            return None
        sent = self._robot.send(force, now)
        if sent is None and self._robot.ended is not None:
            self._filter.halt(self._robot.ended.reason, now)
        self._filter.sent(sent)
        return sent
