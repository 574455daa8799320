"""``contactgraph robot check``: whether an arm is fit to be controlled."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from contactgraph_franka.cli.robot_options import ArmOptions

_LEAST_HZ = 500.0
_MOST_LATE_MS = 3.0
"""99 % of ticks."""


@dataclass(frozen=True)
class Check:
    """Say what arm it is, its state and limits, and how well a loop with it keeps time.

    The hand is held where it is, softly, while that is measured.
    """

    address: Positional[Annotated[str, arg(metavar="ADDR")]]
    """The arm's address, one in a rehearsal, or fake."""
    seconds: float = 5.0
    """For how long the loop is measured."""
    max_force: Annotated[float, arg(metavar="N")] = 16.0
    """The longest force on the hand, N."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""

    def run(self) -> None:
        """Look, measure and say."""
        from contactgraph.cli.output import check_writable, say, write_json
        from contactgraph_franka.cli.robot_arms import opened
        from contactgraph_franka.cli.robot_fault import RobotFault
        from contactgraph_franka.cli.robot_options import FAKE, check_seconds
        from contactgraph_franka.driver.loop_timing import measure_loop

        check_writable(self.json)
        check_seconds("--seconds", self.seconds)
        nowhere = None if self.address == FAKE else (0.5, 0.0, 0.0)
        options = ArmOptions(block=nowhere, max_force=self.max_force)
        limits = options.limits(self.address)
        with opened(self.address, options) as arm:
            for name, words in arm.describe(limits):
                say(f"{name:<11}{words}")
            timing = measure_loop(arm.robot, limits, arm.clock, self.seconds)
            said = arm.said()
        for line in timing.lines():
            say(line)
        report = timing.report
        write_json(
            self.json,
            {
                "address": self.address,
                **report.to_json(),
                "states_hz": timing.states_hz,
                "state_gap_ms_p50": timing.state_gap_ms_p50,
                "state_gap_ms_p99": timing.state_gap_ms_p99,
                "state_gap_ms_worst": timing.state_gap_ms_worst,
            },
        )
        if not report.completed:
            raise RobotFault(f"the arm stopped: {report.stop.reason.value}. {said}".strip())
        if report.rate_hz < _LEAST_HZ or report.jitter_ms_p99 > _MOST_LATE_MS:
            raise RobotFault(
                f"the loop runs at {report.rate_hz:.0f} Hz with ticks {report.jitter_ms_p99:.1f} "
                f"ms late (99 %); it needs {_LEAST_HZ:.0f} Hz and {_MOST_LATE_MS:g} ms: let this "
                "computer do nothing else, and see docs/real-arm.md about real-time priority"
            )
        say("fit to be controlled")
