"""Measurements of a control loop: its rate, its jitter and its plans."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from contactgraph_franka.loop.planner import PlanResult
from contactgraph_franka.safety.robot import Stop


@dataclass(frozen=True)
class LoopReport:
    """Measurements of one `ControlLoop.run`; times are on its clock, except ``plan_ms``."""

    seconds: float
    """s, of the loop, the stop included."""
    ticks: int
    """Control cycles."""
    rate_hz: float
    """Control cycles a second."""
    jitter_ms_p50: float
    """Deviation of a cycle's begin from its due time, ms."""
    jitter_ms_p99: float
    jitter_ms_worst: float
    overruns: int
    """Cycles left out, because the one before began more than a period late."""
    readings: int
    """Cycles with a new reading."""
    plans: int
    plans_late: int
    """Plans that came after the deadline. They were used all the same."""
    plans_failed: int
    """Calls of the planner without a plan; the previous plan went on."""
    plan_ms_p50: float | None
    """Wall time of planning; None without a plan."""
    plan_ms_p99: float | None
    oldest_plan_ms: float
    """The greatest age of a plan in use, counted from its observation."""
    stop: Stop
    """The end of the episode."""

    @property
    def completed(self) -> bool:
        """Whether the episode ended as intended, and no fault stopped it."""
        return self.stop.reason.wanted

    def to_json(self) -> dict[str, Any]:
        """All numbers by name, and the stop's name and sentence."""
        numbers = asdict(self)
        numbers["stop"] = self.stop.reason.name.lower()
        numbers["stop_sentence"] = self.stop.reason.value
        return numbers

    def lines(self) -> list[str]:
        """The report as text."""
        plans = f"{self.plans}"
        if self.plan_ms_p50 is not None:
            plans += f", {self.plan_ms_p50:.1f} ms median, {self.plan_ms_p99:.1f} ms 99 %"
        return [
            f"loop       {self.rate_hz:.0f} Hz held over {self.seconds:.1f} s, "
            f"{self.overruns} cycles left out",
            f"jitter     {self.jitter_ms_p50:.2f} ms median, {self.jitter_ms_p99:.2f} ms 99 %, "
            f"{self.jitter_ms_worst:.2f} ms worst",
            f"plans      {plans}; {self.plans_late} late, {self.plans_failed} failed, the oldest "
            f"used for {self.oldest_plan_ms:.0f} ms",
            f"end        {self.stop.reason.value}",
        ]


class LoopStatistics:
    """Records a loop's measurements at next to no cost; percentiles are computed at the end."""

    def __init__(self, period: float, plan_deadline: float) -> None:
        """``period`` s between cycles; ``plan_deadline`` s from an observation to its plan."""
        self.readings = 0
        self._period, self._plan_deadline = period, plan_deadline
        self._late: list[float] = []
        self._overruns = self._plans_late = self._plans_failed = 0
        self._plan_s: list[float] = []
        self._oldest_plan = 0.0
        self._began = self._ended = 0.0

    def add_cycle(self, now: float, due: float) -> None:
        """Records a cycle that begins at ``now`` s and was due at ``due`` s."""
        if not self._late:
            self._began = now
        self._ended = now
        self._late.append(now - due)
        self._overruns += max(0, int((now - due) / self._period))

    def add_plan(self, now: float, result: PlanResult) -> None:
        """Records a plan that came at ``now`` s."""
        self._plan_s.append(result.wall_s)
        self._plans_failed += result.policy is None
        self._plans_late += now - result.observed_at > self._plan_deadline

    def add_plan_age(self, now: float, active: PlanResult | None) -> None:
        """Records the age of the plan in use at ``now`` s."""
        if active is not None:
            self._oldest_plan = max(self._oldest_plan, now - active.observed_at)

    def report(self, stop: Stop) -> LoopReport:
        """The measurements of an episode that ended by ``stop``."""
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


@dataclass(frozen=True)
class LoopTiming:
    """Result of `measure_loop`; ms between states are on the robot's own clock."""

    report: LoopReport
    states_hz: float
    """New states of the robot read by the loop, a second."""
    state_gap_ms_p50: float
    """Time between consecutive states."""
    state_gap_ms_p99: float
    state_gap_ms_worst: float

    def to_json(self) -> dict[str, Any]:
        """The report's numbers and these, by name."""
        own = {name: value for name, value in vars(self).items() if name != "report"}
        return {**self.report.to_json(), **own}

    def lines(self) -> list[str]:
        """The measurements as text."""
        return [
            *(line for line in self.report.lines() if not line.startswith("plans")),
            f"states     {self.states_hz:.0f} Hz, the next after {self.state_gap_ms_p50:.2f} ms "
            f"median, {self.state_gap_ms_p99:.2f} ms 99 %, {self.state_gap_ms_worst:.2f} ms worst",
        ]
