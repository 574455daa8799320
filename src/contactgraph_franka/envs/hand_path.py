"""Paths of a hand that are quintic in time (Flash, Hogan 1985), and the force that follows them."""

import numpy as np

STIFFNESS = np.array([600.0, 100.0, 600.0])
"""N/m, the paper's."""
DAMPING = 4.0 * np.sqrt(STIFFNESS)
"""N s/m"""


class HandPath:
    """Motions one after the other, each with the least jerk for its ends."""

    def __init__(self) -> None:
        self._pieces: list[tuple[float, float, np.ndarray]] = []
        self.duration = 0.0
        """s, of all of it."""

    def go(
        self,
        start: np.ndarray,
        speed: np.ndarray,
        end: np.ndarray,
        last: np.ndarray,
        duration: float,
    ) -> None:
        """From ``start`` [3] m at ``speed`` [3] m/s to ``end`` at ``last`` in ``duration`` s."""
        self._pieces.append((self.duration, duration, _quintic(start, speed, end, last, duration)))
        self.duration += duration

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position m, velocity m/s and acceleration m/s^2, each [3], ``time`` s after its start.

        After its end it rests, if it came to rest.
        """
        begin, duration, coefficients = [p for p in self._pieces if p[0] <= time][-1]
        s = np.clip((time - begin) / duration, 0.0, 1.0)
        powers = s ** np.arange(6)
        first = np.arange(6) * s ** np.maximum(np.arange(6) - 1, 0)
        second = np.arange(6) * np.arange(-1, 5) * s ** np.maximum(np.arange(6) - 2, 0)
        return (
            powers @ coefficients,
            first @ coefficients / duration,
            second @ coefficients / duration**2,
        )

    def force(
        self, time: float, position: np.ndarray, velocity: np.ndarray, mass: float
    ) -> np.ndarray:
        """[3] N: spring and damper to the path, and what accelerates ``mass`` kg along it."""
        wanted, speed, acceleration = self.at(time)
        return STIFFNESS * (wanted - position) + DAMPING * (speed - velocity) + mass * acceleration


def _quintic(
    start: np.ndarray, speed: np.ndarray, end: np.ndarray, last: np.ndarray, duration: float
) -> np.ndarray:
    """[6, 3]: position over s in [0, 1], without acceleration at both ends."""
    way = end - start - duration * speed
    change = duration * (last - speed)
    zero = np.zeros(3)
    return np.stack(
        [
            start,
            duration * speed,
            zero,
            10.0 * way - 4.0 * change,
            -15.0 * way + 7.0 * change,
            6.0 * way - 3.0 * change,
        ]
    )
