"""How a loop went, in numbers."""

from dataclasses import asdict, dataclass
from typing import Any

from contactgraph_franka.robot.stop import Stop


@dataclass(frozen=True)
class LoopReport:
    """What `ControlLoop.run` has measured; times are on its clock, but for ``plan_ms``."""

    seconds: float
    """s, that the loop ran, the stop included."""
    ticks: int
    rate_hz: float
    """Ticks a second, as held."""
    jitter_ms_p50: float
    """How far a tick began from where it should have, ms."""
    jitter_ms_p99: float
    jitter_ms_worst: float
    overruns: int
    """Ticks that were due and left out, because the one before came more than a period late."""
    readings: int
    """Ticks in which a new reading had come."""
    plans: int
    plans_late: int
    """Of these, how many were there later than the deadline. They were used all the same."""
    plans_failed: int
    """How often the planner found none; the one before went on."""
    plan_ms_p50: float | None
    """What planning took, in wall time; None without a plan."""
    plan_ms_p99: float | None
    oldest_plan_ms: float
    """The greatest age that a plan came to before there was a newer one, from its moment on."""
    stop: Stop
    """How the run ended."""

    @property
    def completed(self) -> bool:
        """Whether the run ended as it should, and nothing stopped it before."""
        return self.stop.reason.wanted

    def to_json(self) -> dict[str, Any]:
        """All numbers by name, the stop as a sentence."""
        numbers = asdict(self)
        numbers["stop"] = self.stop.reason.name.lower()
        numbers["stop_sentence"] = self.stop.reason.value
        return numbers

    def lines(self) -> list[str]:
        """The same for people."""
        plans = f"{self.plans}"
        if self.plan_ms_p50 is not None:
            plans += f", {self.plan_ms_p50:.1f} ms median, {self.plan_ms_p99:.1f} ms 99 %"
        return [
            f"loop       {self.rate_hz:.0f} Hz held over {self.seconds:.1f} s, "
            f"{self.overruns} ticks left out",
            f"jitter     {self.jitter_ms_p50:.2f} ms median, {self.jitter_ms_p99:.2f} ms 99 %, "
            f"{self.jitter_ms_worst:.2f} ms worst",
            f"plans      {plans}; {self.plans_late} late, {self.plans_failed} failed, the oldest "
            f"followed for {self.oldest_plan_ms:.0f} ms",
            f"end        {self.stop.reason.value}",
        ]
