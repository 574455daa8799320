"""How a loop went, in numbers."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from contactgraph_franka.loop.planner import PlanResult
from contactgraph_franka.safety.robot import Stop


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


class LoopStatistics:
    """Counts ticks at next to no cost; percentiles are for the end."""

    def __init__(self, period: float, plan_deadline: float) -> None:
        """``period`` s between ticks; ``plan_deadline`` s from a moment to its plan."""
        self.readings = 0
        self._period, self._plan_deadline = period, plan_deadline
        self._late: list[float] = []
        self._overruns = self._plans_late = self._plans_failed = 0
        self._plan_s: list[float] = []
        self._oldest_plan = 0.0
        self._began = self._ended = 0.0

    def tick(self, now: float, due: float) -> None:
        """A tick begins at ``now`` s that was due at ``due`` s."""
        if not self._late:
            self._began = now
        self._ended = now
        self._late.append(now - due)
        self._overruns += max(0, int((now - due) / self._period))

    def planned(self, now: float, planned: PlanResult) -> None:
        """A plan came at ``now`` s."""
        self._plan_s.append(planned.wall_s)
        self._plans_failed += planned.law is None
        self._plans_late += now - planned.moment > self._plan_deadline

    def follows(self, now: float, running: PlanResult | None) -> None:
        """``running`` is what there is to act by at ``now`` s."""
        if running is not None:
            self._oldest_plan = max(self._oldest_plan, now - running.moment)

    def report(self, stop: Stop) -> LoopReport:
        """All of it."""
        late_ms = 1e3 * np.abs(self._late)
        plan_ms = 1e3 * np.array(self._plan_s)
        seconds = self._ended - self._began
        return LoopReport(
            seconds=seconds,
            ticks=len(self._late),
            rate_hz=(len(self._late) - 1) / seconds if seconds > 0.0 else 0.0,
            jitter_ms_p50=float(np.percentile(late_ms, 50)),
            jitter_ms_p99=float(np.percentile(late_ms, 99)),
            jitter_ms_worst=float(late_ms.max()),
            overruns=self._overruns,
            readings=self.readings,
            plans=len(self._plan_s),
            plans_late=self._plans_late,
            plans_failed=self._plans_failed,
            plan_ms_p50=float(np.percentile(plan_ms, 50)) if plan_ms.size else None,
            plan_ms_p99=float(np.percentile(plan_ms, 99)) if plan_ms.size else None,
            oldest_plan_ms=1e3 * self._oldest_plan,
            stop=stop,
        )
