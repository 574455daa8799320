"""What a loop counts while it runs."""

import numpy as np

from contactgraph_franka.loop.planning import Planned
from contactgraph_franka.loop.report import LoopReport
from contactgraph_franka.robot.stop import Stop


class Tally:
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

    def planned(self, now: float, planned: Planned) -> None:
        """A plan came at ``now`` s."""
        self._plan_s.append(planned.wall_s)
        self._plans_failed += planned.law is None
        self._plans_late += now - planned.moment > self._plan_deadline

    def follows(self, now: float, running: Planned | None) -> None:
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
