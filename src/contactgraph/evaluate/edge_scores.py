"""Predicted contacts against true ones: scores, and delays of a controller's estimates."""

import math
from dataclasses import dataclass, field

import numpy as np

from contactgraph.data import Trajectory, pair_indices
from contactgraph.evaluate.statistics import Sums, finite_or_none


@dataclass(frozen=True)
class EdgeCounts(Sums):
    """Counts of agreement between prediction and truth; those of several trajectories add up.

    A score is None where there is nothing to divide by.
    """

    hits: int = 0
    false_alarms: int = 0
    misses: int = 0
    total: int = 0
    """All edges in all steps."""

    @property
    def precision(self) -> float | None:
        """Share of predicted contacts that are true."""
        return _share(self.hits, self.hits + self.false_alarms)

    @property
    def recall(self) -> float | None:
        """Share of true contacts that are predicted."""
        return _share(self.hits, self.hits + self.misses)

    @property
    def f1(self) -> float | None:
        """Harmonic mean of the two."""
        return _share(2 * self.hits, 2 * self.hits + self.false_alarms + self.misses)

    @property
    def accuracy(self) -> float | None:
        """Share of edges and steps that are right."""
        return _share(self.total - self.false_alarms - self.misses, self.total)

    @property
    def false_alarm_rate(self) -> float | None:
        """Share of edges and steps without contact for which contact is predicted."""
        return _share(self.false_alarms, self.total - self.hits - self.misses)


def edge_counts(predicted: np.ndarray, true: np.ndarray, exists: np.ndarray) -> EdgeCounts:
    """Counts of ``predicted`` against ``true``, both [W, H, E] bool.

    ``exists``: [W, E] bool, False for padding.
    """
    return EdgeCounts(
        hits=_count(predicted & true, exists),
        false_alarms=_count(predicted & ~true, exists),
        misses=_count(~predicted & true, exists),
        total=int(exists.sum()) * predicted.shape[1],
    )


def switch_time_errors(
    predicted: np.ndarray, contact: np.ndarray, exists: np.ndarray
) -> np.ndarray:
    """[onsets] steps, at least 0, between the predicted and the true onset of contact.

    Step h of ``predicted`` [W, H, E] leads to state h + 1 of ``contact`` [W, H+1, E], both bool.
    One entry for every window and edge that is not in contact in the window's first state and is
    later: the steps between the first true contact and the first predicted one in that window.
    Where none is predicted, the error is the rest of the window from the true onset on.
    """
    true = contact[:, 1:]
    onset = exists & ~contact[:, 0] & true.any(axis=1)
    actual = true.argmax(axis=1)
    predicted_onset = np.where(predicted.any(axis=1), predicted.argmax(axis=1), predicted.shape[1])
    return np.abs(predicted_onset - actual)[onset]


def _count(found: np.ndarray, exists: np.ndarray) -> int:
    return int((found.sum(axis=1) * exists).sum())


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


@dataclass(frozen=True)
class EstimatedContacts(Sums):
    """Beliefs about the step just made, corrected by all observations; episodes add up.

    They are about holds where these were recorded, else about contacts. A delay lasts from the
    first observation at which a contact exists, or no longer exists, to the first one from then on
    at which the belief agrees; 0 where the belief agreed at once or before, infinite where it never
    agreed while the contact, or its absence, lasted.
    """

    edges: EdgeCounts = field(default_factory=EdgeCounts)
    """Beliefs above 1/2 or not, against contacts."""
    onset_delays: tuple[float, ...] = ()
    """s; of every contact that began."""
    break_delays: tuple[float, ...] = ()
    """s; of every contact that ended."""
    failed_grasp_delays: tuple[float, ...] = ()
    """s; of every touch that began without a hold, as long as it does not hold."""

    def to_json(self) -> dict[str, float | int | None]:
        """All numbers by name; None for those that are not known, or infinite because the contact
        in question was never estimated."""
        found: dict[str, float | int | None] = {
            "edge_precision_found": self.edges.precision,
            "edge_recall_found": self.edges.recall,
            "edge_f1_found": self.edges.f1,
        }
        for name in ("onset", "break", "failed_grasp"):
            delays = getattr(self, f"{name}_delays")
            found[f"{name}s"] = len(delays)
            for share in (50, 95):
                found[f"{name}_delay_ms_p{share}"] = _percentile_ms(delays, share)
        return found


def estimated_contacts(trajectory: Trajectory, belief: np.ndarray) -> EstimatedContacts:
    """The estimates of one episode; empty where contacts were not recorded.

    ``belief``: [S, E] probabilities at the first S observations, in `pair_indices`' order; of
    holding, where the trajectory tells it.
    """
    if trajectory.contact is None:
        return EstimatedContacts()
    first, second = pair_indices(trajectory.scene.node_count).T
    labels = trajectory.contact if trajectory.holding is None else trajectory.holding
    contact, true = (
        each[: len(belief), first, second].astype(bool) for each in (trajectory.contact, labels)
    )
    estimated = belief > 0.5
    exists = np.ones((1, len(first)), dtype=bool)
    dt = trajectory.scene.dt
    return EstimatedContacts(
        edges=edge_counts(estimated[None], true[None], exists),
        onset_delays=_delays(estimated, true, true, dt),
        break_delays=_delays(~estimated, ~true, ~true, dt),
        failed_grasp_delays=_delays(~estimated, contact & ~true, contact, dt),
    )


def _delays(
    active: np.ndarray, true: np.ndarray, within: np.ndarray, dt: float
) -> tuple[float, ...]:
    """s; of every interval of ``true`` [S, E] that begins after the first observation, together
    with one of ``within``."""
    delays = []
    for last_without, edge in np.argwhere(true[1:] & ~within[:-1]):
        begin = last_without + 1
        after = true[begin:, edge]
        lasts = len(after) if after.all() else int(np.argmin(after))
        estimated = active[begin : begin + lasts, edge]
        delays.append(dt * int(np.argmax(estimated)) if estimated.any() else math.inf)
    return tuple(delays)


def _percentile_ms(delays: tuple[float, ...], share: float) -> float | None:
    if not delays:
        return None
    # A measured value, not an interpolated one, because a delay can be infinite.
    return finite_or_none(1e3 * float(np.percentile(delays, share, method="higher")))
