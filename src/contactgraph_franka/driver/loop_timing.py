"""How well a robot and the loop keep time with each other, while the hand is held where it is."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.loop import Clock, ControlLoop, LoopReport, Moment, Planned, Start
from contactgraph_franka.robot.contract import Robot, RobotReading
from contactgraph_franka.robot.limits import SafetyLimits
from contactgraph_franka.robot.safe_robot import SafeRobot

_STIFFNESS = 200.0
"""N/m"""
_DAMPING = 57.0
"""N s/m: critical for the hand's 4 kg."""
_LARGEST = 8.0
"""N: what pushes harder than this moves the hand."""


@dataclass(frozen=True)
class LoopTiming:
    """What `measure_loop` found; ms between states are on the robot's own clock."""

    report: LoopReport
    """Of the loop: its rate, and how late its ticks were."""
    states_hz: float
    """New states of the robot that the loop got, a second."""
    state_gap_ms_p50: float
    """From one of these to the next."""
    state_gap_ms_p99: float
    state_gap_ms_worst: float

    def lines(self) -> list[str]:
        """The same for people."""
        return [
            *(line for line in self.report.lines() if not line.startswith("plans")),
            f"states     {self.states_hz:.0f} Hz, the next after {self.state_gap_ms_p50:.2f} ms "
            f"median, {self.state_gap_ms_p99:.2f} ms 99 %, {self.state_gap_ms_worst:.2f} ms worst",
        ]


@dataclass(frozen=True, eq=False)
class HoldingLaw:
    """Holds the hand where it was, as a soft spring."""

    place: np.ndarray
    """[D] m"""
    duration: float
    """s"""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[D] N, at [N, D] m and m/s."""
        force = _STIFFNESS * (self.place - position[0]) - _DAMPING * velocity[0]
        return force * min(1.0, _LARGEST / max(float(np.linalg.norm(force)), 1e-9))


class Holding:
    """Planning that takes no time: the hand stays."""

    interval = 0.05
    """s"""

    def begin(self, start: Start) -> None:
        """Where the hand is now is where it stays."""
        self._law = HoldingLaw(start.reading.position[0].copy(), duration=1.0)
        self._planned: Planned | None = None

    def offer(self, moment: Moment) -> None:
        """Goes on."""
        self._planned = Planned(self._law, moment.time, 0.0)

    def done(self) -> Planned | None:
        """The law, once for each moment."""
        planned, self._planned = self._planned, None
        return planned


def measure_loop(robot: Robot, limits: SafetyLimits, clock: Clock, seconds: float) -> LoopTiming:
    """Holds the hand for ``seconds`` with all that a tick needs: read, limits, law, send.

    ``clock`` must be the robot's. Raises `InvalidInputError` where ``seconds`` is not positive, or
    the robot sends nothing.
    """
    if not seconds > 0.0:
        raise InvalidInputError(f"seconds must be positive, found {seconds}")
    times: list[float] = []

    def note(now: float, reading: RobotReading | None, sent: np.ndarray | None) -> None:
        if reading is not None:
            times.append(reading.robot_time)

    loop = ControlLoop(SafeRobot(robot, limits, clock), Holding(), clock)
    report = loop.run(seconds, np.zeros(len(limits.workspace_low)), on_tick=note)
    gaps = 1e3 * np.diff(times) if len(times) > 1 else np.full(1, np.nan)
    return LoopTiming(
        report=report,
        states_hz=len(times) / max(report.seconds, 1e-9),
        state_gap_ms_p50=float(np.percentile(gaps, 50)),
        state_gap_ms_p99=float(np.percentile(gaps, 99)),
        state_gap_ms_worst=float(gaps.max()),
    )
