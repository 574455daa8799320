"""Planning as the loop sees it: it hands moments over and takes laws, and never waits."""

from dataclasses import dataclass
from typing import Protocol

from contactgraph_franka.loop.planner import Law, Moment, Start


@dataclass(frozen=True, eq=False)
class Planned:
    """What planning from a moment came to."""

    law: Law | None
    """None: no plan was found."""
    moment: float
    """s, on the loop's clock: what it was made from."""
    wall_s: float
    """Wall seconds that it took."""


class Planning(Protocol):
    """A planner beside the loop."""

    @property
    def interval(self) -> float:
        """s between the moments that are to be offered."""

    def begin(self, start: Start) -> None:
        """Prepares for a run; this alone may take long. Raises what `Planner.begin` raises."""

    def offer(self, moment: Moment) -> None:
        """Something to plan from. Does not wait."""

    def done(self) -> Planned | None:
        """What was planned since the last call. Does not wait; None: nothing yet.

        Raises whatever planning ended with for good.
        """
