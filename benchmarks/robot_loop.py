"""Rate of the loop to an arm: read, limits, impedance, send, behind the real protocol.

Usage: python benchmarks/robot_loop.py [--quick] [--json FILE]

The real client talks to a simulated arm in a process of its own, in real time, and holds its hand
where it is; each row is a run of 30 s (``--quick``: 3 s). Needs the extra ``rehearsal``. On a
machine with two cores, anything else that runs is in the numbers.
"""

import time
from importlib.util import find_spec

import numpy as np
from measuring import arguments, report

from contactgraph_franka.loop import WallClock
from contactgraph_franka.loop.control_loop import measure_loop
from contactgraph_franka.safety import Robot, RobotReading, SafetyLimits, Stop

LIMITS = SafetyLimits(max_force=14.0, longest_gap=0.1, longest_age=0.1, stop_within=0.2)
"""Long deadlines, so that delays are measured instead of stopping the loop."""


class Timed:
    """A robot whose calls are timed."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.read_s: list[float] = []
        self.send_s: list[float] = []

    @property
    def ended(self) -> Stop | None:
        return self._robot.ended

    def read(self) -> RobotReading | None:
        began = time.perf_counter()
        reading = self._robot.read()
        if reading is not None:
            self.read_s.append(time.perf_counter() - began)
        return reading

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        began = time.perf_counter()
        sent = self._robot.send(force, now)
        self.send_s.append(time.perf_counter() - began)
        return sent

    def stop(self, stop: Stop) -> None:
        self._robot.stop(stop)

    def resume(self) -> None:
        self._robot.resume()


def measured(seconds: float) -> dict[str, float | int | str]:
    """One row: one run."""
    from contactgraph_franka.driver.franka_robot import FrankaRobot
    from contactgraph_franka.sim.simulated_robot import RobotSimulator

    clock = WallClock()
    with RobotSimulator(pace=1.0) as arm, FrankaRobot(arm.address, clock=clock) as robot:
        timed = Timed(robot)
        timing = measure_loop(timed, LIMITS, clock, seconds)
        held = timing.report
        return {
            "seconds": held.seconds,
            "Hz held": held.rate_hz,
            "late p50 ms": held.jitter_ms_p50,
            "p99 ms": held.jitter_ms_p99,
            "worst ms": held.jitter_ms_worst,
            "left out": held.overruns,
            "states Hz": timing.states_hz,
            "gap p99 ms": timing.state_gap_ms_p99,
            "gap worst": timing.state_gap_ms_worst,
            "read us": 1e6 * float(np.median(timed.read_s)),
            "send us": 1e6 * float(np.median(timed.send_s)),
            "arm Hz": arm.rate,
            "end": held.stop.reason.name.lower(),
        }


def main() -> None:
    """Measure and print."""
    options = arguments("The feedback loop to an arm.")
    if find_spec("franky_sim") is None:
        print("robot_loop is left out: it needs pip install 'contactgraph[rehearsal]'")
        return
    rows = [measured(3.0 if options.quick else 30.0) for _ in range(1 if options.quick else 2)]
    report("robot_loop", rows, options)


if __name__ == "__main__":
    main()
