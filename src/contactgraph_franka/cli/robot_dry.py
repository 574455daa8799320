"""A run of which the arm notices nothing."""

import numpy as np

from contactgraph.cli.output import say
from contactgraph_franka.loop import FeedbackLaw, Moment, Planned, Planning, Start
from contactgraph_franka.robot import Robot, RobotReading, Stop

_EVERY = 0.5
"""s between plans that are said."""


class DryRobot:
    """A `Robot` that is read, and sent nothing: every force that is asked for is none."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @property
    def ended(self) -> Stop | None:
        """As the robot tells."""
        return self._robot.ended

    def read(self) -> RobotReading | None:
        """As the robot tells."""
        return self._robot.read()

    def send(self, force: np.ndarray, now: float) -> np.ndarray:
        """Nothing."""
        return np.zeros_like(force)

    def stop(self, stop: Stop) -> None:
        """It rests."""

    def resume(self) -> None:
        """It stays out of control."""


class SpokenPlans:
    """A `Planning` that says a plan now and then."""

    def __init__(self, planning: Planning) -> None:
        self._planning = planning
        self.interval = planning.interval

    def begin(self, start: Start) -> None:
        """See `Planning`."""
        self._planning.begin(start)
        self._began: float | None = None
        self._due = 0.0

    def offer(self, moment: Moment) -> None:
        """See `Planning`."""
        if self._began is None:
            self._began = self._due = moment.time
        self._planning.offer(moment)

    def done(self) -> Planned | None:
        """See `Planning`."""
        planned = self._planning.done()
        if planned is None or self._began is None or planned.moment < self._due:
            return planned
        self._due = planned.moment + _EVERY
        if isinstance(planned.law, FeedbackLaw):
            hand, block = planned.law.states[-1, :2, 0]
            push = _numbers(1, planned.law.controls[0])
            say(
                f"at {planned.moment - self._began:4.1f} s: first push {push} N; "
                f"in {planned.law.duration:g} s the hand at {_numbers(2, hand)} m, "
                f"the block at {_numbers(2, block)} m"
            )
        return planned


def _numbers(digits: int, values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in values) + ")"
