r"""Kalman filter of an object's position and velocity from delayed, noisy measurements.

The state $(p, v)$ has white acceleration of density $q$ on each axis: over a time
$\tau$

$$ F = [1, \tau; 0, 1], \quad Q = q\,[\tau^3/3, \tau^2/2; \tau^2/2, \tau] $$

The state refers to the exposure of the last accepted frame; only estimates are predicted to the
present. A delay therefore costs certainty, and nothing has to be undone.

An impact changes the velocity of an object at once, which white acceleration does not explain. So
each measurement has three explanations, tried in this order: smooth motion; an impact since the
last frame, which adds `Motion.impulse_noise` to $v$; or an outlier. Outliers are left out
until several in a row agree with each other.
"""

import math
from dataclasses import dataclass

import numpy as np

from contactgraph_franka.perception.camera import AHEAD

_SMOOTH = 11.3
"""99 % quantile of the squared Mahalanobis distance (3 degrees of freedom): smooth motion."""
_GATE = 16.3  # 99.9 % quantile: measurements beyond it are outliers
_FIRST_SPEED = 0.5  # m/s, standard deviation of the initial velocity
_FORGOTTEN_AFTER = 1.0  # s without a measurement after which the filter restarts
_OLDER = 3
"""Measurements in a row that are older than the newest, which then had a wrong time."""
_LOST_ABOVE = 0.05
"""m: largest standard deviation of a tracked position. That of a block 0.07 s after an impact is
0.02 m, which must not stop the hand that grasps it."""


@dataclass(frozen=True)
class Motion:
    """Motion model of an object relative to its carrier."""

    density: float
    """m^2/s^3: of white acceleration."""
    impulse_noise: float
    """m/s, standard deviation of the velocity change of an impact."""
    consistent: int
    """Outliers in a row, consistent with each other, that restart the filter."""
    lost_after: float
    """s without a measurement."""


FREE = Motion(density=0.1, impulse_noise=0.6, consistent=3, lost_after=0.2)
"""White acceleration of 1.7 m/s^2 from frame to frame at 30 Hz (its square times 1/30 s), enough
for a pickup in one sweep, from rest to 0.5 m/s in 0.3 s. Lower densities lag; higher ones make
resting objects jitter. An impact transfers about the speed of the hand."""
GRASPED = Motion(density=1e-3, impulse_noise=0.05, consistent=15, lost_after=1.0)
"""A grasped object slips and tilts by 0.2 m/s^2 from frame to frame. This averages the tilt of a
single tag, uncertain by 1 cm, and ignores a mistaken one."""


@dataclass(frozen=True, eq=False, slots=True)
class PositionMeasurement:
    """Position of an object in one frame, in the frame of the robot's base."""

    position: np.ndarray
    """[3] m"""
    covariance: np.ndarray
    """[3, 3] m^2"""
    time: float
    """s: the exposure."""


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """An object at the requested time."""

    position: np.ndarray
    """[3] m"""
    velocity: np.ndarray
    """[3] m/s"""
    variance: np.ndarray
    """[3] m^2, of ``position``."""
    time: float
    """s: exposure of the last accepted frame, minus infinity if none. The requested time for a
    grasped object, since the hand is measured then."""
    tracked: bool
    """Whether the last accepted frame is recent (`Motion`) and each axis is known to 0.05 m."""


@dataclass(frozen=True, eq=False, slots=True)
class FilterState:
    """Mean and covariance of position and velocity at one time."""

    time: float
    """s"""
    mean: np.ndarray
    """[6]: m, m/s."""
    covariance: np.ndarray
    """[6, 6]"""
    begun: float = -math.inf
    """s: when the filter last restarted."""
    density: float = math.inf
    """m^2/s^3, of the acceleration assumed since the previous state."""

    def estimate(self, now: float, motion: Motion = FREE) -> Estimate:
        """The state predicted to ``now`` s; unchanged for an earlier time."""
        since = now - self.time
        ahead = max(since, 0.0)
        p, v = self.mean[:3], self.mean[3:]
        diagonal = self.covariance.diagonal()
        cross = self.covariance.diagonal(3)
        variance = (
            diagonal[:3]
            + (2.0 * ahead) * cross
            + (ahead * ahead) * diagonal[3:]
            + (motion.density * ahead * ahead * ahead / 3.0)
        )
        tracked = -AHEAD <= since <= motion.lost_after and max(variance.tolist()) <= _LOST_ABOVE**2
        return Estimate(p + ahead * v, v.copy(), variance, self.time, tracked)


NEVER_SEEN = Estimate(np.zeros(3), np.zeros(3), np.full(3, np.inf), -math.inf, False)
"""Estimate of an object before its first measurement."""


class ObjectTracker:
    """Tracks one object."""

    def __init__(self) -> None:
        self.state: FilterState | None = None
        """At the last accepted frame; None before the first."""
        self._newest = -math.inf
        self._older = 0
        """Measurements in a row that are older than the newest by more than a filter lasts."""
        self._outliers: list[FilterState] = []

    def measure(
        self, position: np.ndarray, covariance: np.ndarray, time: float, motion: Motion = FREE
    ) -> bool:
        """Adds a measurement ``position`` [3] m of the exposure at ``time`` s; True if accepted.

        ``covariance`` [3, 3] m^2; ``motion`` is the model since the last measurement. Measurements
        that are not newer, or not finite, are ignored; but where three in a row are older by more
        than a second, the newest had a wrong time, and the filter restarts.
        """
        finite = np.isfinite(position).all() and np.isfinite(covariance).all()
        if not (finite and math.isfinite(time)):
            return False
        self._older = self._older + 1 if time < self._newest - _FORGOTTEN_AFTER else 0
        if self._older == _OLDER:
            self._newest, self._older, self.state = -math.inf, 0, None
        if not time > self._newest:
            return False
        self._newest = time
        if self.state is None or time - self.state.time > _FORGOTTEN_AFTER:
            self._outliers = []
            self.state = _initial(position, covariance, time)
            return True
        updated = _updated(self.state, position, covariance, time, motion)
        if updated is None:
            updated = self._consistent_outliers(position, covariance, time, motion)
        if updated is None:
            return False
        self.state, self._outliers = updated, []
        return True

    def estimate(self, now: float) -> Estimate:
        """The estimate at ``now`` s."""
        return NEVER_SEEN if self.state is None else self.state.estimate(now)

    def _consistent_outliers(
        self, position: np.ndarray, covariance: np.ndarray, time: float, motion: Motion
    ) -> FilterState | None:
        """The filter of the latest outliers, once enough of them agree."""
        agreed = None
        if self._outliers:
            agreed = _updated(self._outliers[-1], position, covariance, time, motion)
        if agreed is None:
            self._outliers = [_initial(position, covariance, time)]
            return None
        self._outliers.append(agreed)
        return agreed if len(self._outliers) >= motion.consistent else None


def _initial(position: np.ndarray, covariance: np.ndarray, time: float) -> FilterState:
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
    """The state after a measurement; None for an outlier."""
    step = time - state.time
    mean = state.mean.copy()
    mean[:3] += step * mean[3:]
    innovation = position - mean[:3]
    # An impact at a moment uniformly distributed over the step has the covariance of white
    # acceleration of density impulse_noise**2 / step.
    for extra, gate in ((0.0, _SMOOTH), (motion.impulse_noise**2 / step, _GATE)):
        density = motion.density + extra
        spread = predicted(state.covariance, step, density)
        total = spread[:3, :3] + covariance
        gain = np.linalg.solve(total, spread[:3]).T
        distance = float(innovation @ np.linalg.solve(total, innovation))
        if distance <= gate:
            # Joseph's form stays symmetric and positive under rounding.
            keep = np.eye(6)
            keep[:, :3] -= gain
            updated = keep @ spread @ keep.T + gain @ covariance @ gain.T
            return FilterState(time, mean + gain @ innovation, updated, state.begun, density)
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
