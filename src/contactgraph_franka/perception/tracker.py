r"""Position and velocity of an object from late, noisy, sometimes missing or wrong measurements.

A Kalman filter with state :math:`(p, v)` and white acceleration of density :math:`q` on each axis:
over a time :math:`\tau`

.. math:: F = [1, \tau; 0, 1], \quad Q = q\,[\tau^3/3, \tau^2/2; \tau^2/2, \tau]

Its state stands at the exposure of the last frame that counted; only what is asked for is predicted
to now. So a delay costs certainty, and nothing has to be undone.

An impact changes the velocity of an object at once, which white acceleration does not explain. So
each measurement has three explanations, tried in this order: smooth motion; an impact since the
last frame, which adds `Motion.impulse_noise` to :math:`v`; or an outlier. Outliers are left out
until several in a row agree with each other.
"""

import math
from dataclasses import dataclass

import numpy as np

_SMOOTH = 11.3
"""Squared Mahalanobis distance (3 degrees of freedom) that 99 % of smooth motion stays below."""
_GATE = 16.3
"""The same for 99.9 %: beyond it, a measurement is wrong."""
_FIRST_SPEED = 0.5
"""m/s, standard deviation of the velocity at a start."""
_FORGOTTEN_AFTER = 1.0
"""s without a measurement after which nothing is known of how it moves: the filter starts anew."""
_LOST_ABOVE = 0.05
"""m: standard deviation along the worst axis. Where a block that was just struck is now, 0.07 s
after the last frame, is known to 0.02 m only: that must not stop the hand that grasps it."""


@dataclass(frozen=True)
class Motion:
    """How an object may move, seen from what carries it."""

    density: float
    """m^2/s^3: of white acceleration."""
    impulse_noise: float
    """m/s, standard deviation of the change of its velocity when it is struck."""
    consistent: int
    """Measurements in a row that agree with each other, not with the filter: it starts anew."""
    lost_after: float
    """s without a measurement."""


FREE = Motion(density=0.1, impulse_noise=0.6, consistent=3, lost_after=0.2)
"""White acceleration of 1.7 m/s^2 from frame to frame at 30 Hz (its square times 1/30 s): as much
as an arm needs that picks a block up in one sweep, from rest to 0.5 m/s in 0.3 s. Less lags behind;
more lets what rests jitter. A hand that strikes it moves about as fast as it does then."""
GRASPED = Motion(density=1e-3, impulse_noise=0.05, consistent=15, lost_after=1.0)
"""In a hand it slips and tilts, by 0.2 m/s^2 from frame to frame. So a lone tag's leaning, which is
uncertain by 1 cm, averages out, and one that is taken for another counts for nothing."""


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """Where an object is at the time that was asked for."""

    position: np.ndarray
    """[3] m"""
    velocity: np.ndarray
    """[3] m/s"""
    variance: np.ndarray
    """[3] m^2, of ``position``."""
    time: float
    """s: the exposure of the last frame that counted; minus infinity where there was none. Of what
    a hand holds, when it was asked: the hand is measured then."""
    tracked: bool
    """Whether a frame counted not long ago (`Motion`), and no axis is less sure than 0.05 m."""


@dataclass(frozen=True, eq=False, slots=True)
class FilterState:
    """Position and velocity at one moment, and how sure they are."""

    time: float
    """s"""
    mean: np.ndarray
    """[6]: m, m/s."""
    covariance: np.ndarray
    """[6, 6]"""
    begun: float = -math.inf
    """s: when the filter last started, knowing nothing of before."""
    density: float = math.inf
    """m^2/s^3, of the acceleration that explains the way here from the state before."""

    def estimate(self, now: float, motion: Motion = FREE) -> Estimate:
        """The state at ``now`` s, which may be before its own time: then it is that time's."""
        ahead = now - self.time
        if not ahead > 0.0:
            ahead = 0.0
        p, v = self.mean[:3], self.mean[3:]
        diagonal = self.covariance.diagonal()
        cross = self.covariance.diagonal(3)
        variance = (
            diagonal[:3]
            + (2.0 * ahead) * cross
            + (ahead * ahead) * diagonal[3:]
            + (motion.density * ahead * ahead * ahead / 3.0)
        )
        tracked = ahead <= motion.lost_after and max(variance.tolist()) <= _LOST_ABOVE**2
        return Estimate(p + ahead * v, v.copy(), variance, self.time, tracked)


NEVER_SEEN = Estimate(np.zeros(3), np.zeros(3), np.full(3, np.inf), -math.inf, False)
"""Of an object that no frame has shown yet."""


class ObjectTracker:
    """Tracks one object."""

    def __init__(self) -> None:
        self.state: FilterState | None = None
        """At the last frame that counted; None before the first."""
        self._newest = -math.inf
        self._doubtful: list[FilterState] = []

    def measure(
        self, position: np.ndarray, covariance: np.ndarray, time: float, motion: Motion = FREE
    ) -> bool:
        """A frame exposed at ``time`` s showed the object at ``position`` [3] m.

        ``covariance`` [3, 3] m^2; ``motion`` is how it may have moved since the last. True where
        it counts; frames no newer than the last, and measurements that are not finite, change
        nothing.
        """
        finite = np.isfinite(position).all() and np.isfinite(covariance).all()
        if not (finite and math.isfinite(time) and time > self._newest):
            return False
        self._newest = time
        if self.state is None or time - self.state.time > _FORGOTTEN_AFTER:
            self._doubtful = []
            self.state = _started(position, covariance, time)
            return True
        updated = _updated(self.state, position, covariance, time, motion)
        if updated is None:
            updated = self._agreed(position, covariance, time, motion)
        if updated is None:
            return False
        self.state, self._doubtful = updated, []
        return True

    def estimate(self, now: float) -> Estimate:
        """Where the object is at ``now`` s, as far as known."""
        if self.state is None:
            return NEVER_SEEN
        return self.state.estimate(now)

    def _agreed(
        self, position: np.ndarray, covariance: np.ndarray, time: float, motion: Motion
    ) -> FilterState | None:
        """What the doubtful measurements in a row say, once they are enough and agree."""
        last = self._doubtful[-1] if self._doubtful else None
        agreed = None
        if last is not None:
            agreed = _updated(last, position, covariance, time, motion)
        if agreed is None:
            self._doubtful = [_started(position, covariance, time)]
            return None
        self._doubtful.append(agreed)
        return agreed if len(self._doubtful) >= motion.consistent else None


def _started(position: np.ndarray, covariance: np.ndarray, time: float) -> FilterState:
    spread = np.zeros((6, 6))
    spread[:3, :3] = covariance
    spread[3:, 3:] = _FIRST_SPEED**2 * np.eye(3)
    return FilterState(time, np.concatenate([position, np.zeros(3)]), spread, time, math.inf)


def _updated(
    state: FilterState,
    position: np.ndarray,
    covariance: np.ndarray,
    time: float,
    motion: Motion,
) -> FilterState | None:
    """The state after a measurement; None where it is wrong, whatever happened to the object."""
    step = time - state.time
    mean = state.mean.copy()
    mean[:3] += step * mean[3:]
    innovation = position - mean[:3]
    density, impulse = motion.density, motion.impulse_noise**2
    # An impact at a moment uniformly distributed over the step has the covariance of white
    # acceleration of density impulse_noise**2 / step.
    for extra, gate in ((0.0, _SMOOTH), (impulse / step, _GATE)):
        spread = predicted(state.covariance, step, density + extra)
        seen = spread[:3, :3] + covariance
        gain = np.linalg.solve(seen, spread[:3]).T
        distance = float(innovation @ np.linalg.solve(seen, innovation))
        if distance <= gate:
            # Joseph's form stays symmetric and positive whatever is rounded.
            keep = np.eye(6)
            keep[:, :3] -= gain
            updated = keep @ spread @ keep.T + gain @ covariance @ gain.T
            mean = mean + gain @ innovation
            return FilterState(time, mean, updated, state.begun, density + extra)
    return None


def predicted(covariance: np.ndarray, step: float, density: float) -> np.ndarray:
    """The covariance [6, 6] after ``step`` s under white acceleration of ``density`` m^2/s^3."""
    spread = covariance.copy()
    forward = step * covariance[3:]
    spread[:3] += forward
    spread[:, :3] += step * spread[:, 3:]
    each = np.arange(3)
    spread[each, each] += density * step**3 / 3.0
    spread[each, each + 3] += density * step**2 / 2.0
    spread[each + 3, each] += density * step**2 / 2.0
    spread[each + 3, each + 3] += density * step
    return spread
