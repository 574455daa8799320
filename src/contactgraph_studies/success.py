"""How many episodes reached the goal, those of all seeds together."""

from collections.abc import Sequence
from dataclasses import dataclass

from contactgraph.evaluate import wilson_interval
from contactgraph_studies.results import Reading


@dataclass(frozen=True)
class Success:
    """Episodes that reached the goal, of all seeds together."""

    successes: int
    episodes: int

    @property
    def share(self) -> float:
        """Of all episodes."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, Wilson, of the share."""
        return wilson_interval(self.successes, self.episodes)

    def __str__(self) -> str:
        """In per cent, with the interval."""
        low, high = self.interval
        return f"{100 * self.share:.0f} % of {self.episodes} ({100 * low:.0f} to {100 * high:.0f})"


def pooled_success(readings: Sequence[Reading]) -> Success | None:
    """Of closed-loop readings, one a seed; None where there are none."""
    if not readings:
        return None
    counts = [(each.values["success_rate"], int(each.values["episodes"])) for each in readings]
    reached = sum(round(rate * episodes) for rate, episodes in counts)
    return Success(reached, sum(episodes for _, episodes in counts))
