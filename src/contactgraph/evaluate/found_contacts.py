"""How well, and how soon, a controller knows which contacts there are: belief against truth."""

import math
from dataclasses import dataclass, field

import numpy as np

from contactgraph.data import Trajectory, pair_indices
from contactgraph.evaluate.edge_scores import EdgeCounts, edge_counts


@dataclass(frozen=True)
class FoundContacts:
    """Beliefs about the step just made, corrected by all that was observed; episodes add up.

    A delay is counted from the first observation at which a contact holds, or no longer does, to
    the first from then on that is believed; 0 where it was believed at once, or before. Infinite
    where it never was while it lasted.
    """

    edges: EdgeCounts = field(default_factory=EdgeCounts)
    """Beliefs above 1/2 or not, against contacts."""
    onset_delays: tuple[float, ...] = ()
    """s; of every contact that began."""
    break_delays: tuple[float, ...] = ()
    """s; of every contact that ended."""

    def __add__(self, other: "FoundContacts") -> "FoundContacts":
        return FoundContacts(
            self.edges + other.edges,
            self.onset_delays + other.onset_delays,
            self.break_delays + other.break_delays,
        )

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not known, or not finite: then the contact
        that is meant was not found at all."""
        return {
            "edge_precision_found": self.edges.precision,
            "edge_recall_found": self.edges.recall,
            "edge_f1_found": self.edges.f1,
            "onsets": len(self.onset_delays),
            "onset_delay_ms_p50": _percentile_ms(self.onset_delays, 50.0),
            "onset_delay_ms_p95": _percentile_ms(self.onset_delays, 95.0),
            "breaks": len(self.break_delays),
            "break_delay_ms_p50": _percentile_ms(self.break_delays, 50.0),
            "break_delay_ms_p95": _percentile_ms(self.break_delays, 95.0),
        }


def found_contacts(run: Trajectory, belief: np.ndarray) -> FoundContacts:
    """``belief``: [S, E] probabilities at the run's first S observations, in `pair_indices`'
    order. Nothing where contacts were not recorded."""
    if run.contact is None:
        return FoundContacts()
    first, second = pair_indices(run.scene.node_count).T
    true = run.contact[: len(belief), first, second].astype(bool)
    believed = belief > 0.5
    exists = np.ones((1, len(first)), dtype=bool)
    dt = run.scene.dt
    return FoundContacts(
        edges=edge_counts(believed[None], true[None], exists),
        onset_delays=_delays(believed, true, dt),
        break_delays=_delays(~believed, ~true, dt),
    )


def _delays(believed: np.ndarray, true: np.ndarray, dt: float) -> tuple[float, ...]:
    """s; of every stretch of ``true`` [S, E] that begins behind the first observation."""
    delays = []
    for last_without, edge in np.argwhere(true[1:] & ~true[:-1]):
        begin = last_without + 1
        after = true[begin:, edge]
        lasts = len(after) if after.all() else int(np.argmin(after))
        seen = believed[begin : begin + lasts, edge]
        delays.append(dt * int(np.argmax(seen)) if seen.any() else math.inf)
    return tuple(delays)


def _percentile_ms(delays: tuple[float, ...], share: float) -> float | None:
    if not delays:
        return None
    # Of those measured, none in between: between a delay and infinity there is nothing.
    value = 1e3 * float(np.percentile(delays, share, method="higher"))
    return value if math.isfinite(value) else None
