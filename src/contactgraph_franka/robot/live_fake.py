"""The fake robot in real time: an arm for whoever has none."""

import numpy as np

from contactgraph_franka.loop.clock import Clock
from contactgraph_franka.robot.contract import RobotReading
from contactgraph_franka.robot.fake_robot import TICK, FakeRobot
from contactgraph_franka.robot.stop import Stop

_LONGEST_UNSEEN = 0.02
"""s"""


class LiveFake:
    """A `Robot`: a `FakeRobot` that goes on while nobody looks, as arms do.

    Readings are stamped on ``clock``, and at most a tick old.
    """

    def __init__(self, robot: FakeRobot, clock: Clock) -> None:
        self.robot = robot
        self._clock = clock
        self._began = clock() - robot.clock()
        self._read_at = -1.0

    @property
    def ended(self) -> Stop | None:
        """Why the fake robot stopped by itself, if it did."""
        return self.robot.ended

    def read(self) -> RobotReading | None:
        """What the ticks that have passed have led to; None where none has."""
        self._catch_up()
        if self.robot.clock() <= self._read_at:
            return None
        self._read_at = self.robot.clock()
        reading = self.robot.read()
        if reading is None:
            return None
        return RobotReading(
            position=reading.position,
            velocity=reading.velocity,
            time=reading.time + self._began,
            robot_time=reading.robot_time,
            tracked=reading.tracked,
            variance=reading.variance,
            contact=reading.contact,
        )

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """From the next tick on."""
        return self.robot.send(force, now)

    def stop(self, stop: Stop) -> None:
        """Brakes from now on."""
        self.robot.stop(stop)

    def resume(self) -> None:
        """Ends `stop`."""
        self._catch_up()
        self.robot.resume()

    def _catch_up(self) -> None:
        now = self._clock()
        # While nobody looks for long, nothing happens: a second to make up for takes its time.
        self._began = max(self._began, now - self.robot.clock() - _LONGEST_UNSEEN)
        while self.robot.clock() + TICK <= now - self._began:
            self.robot.advance()
