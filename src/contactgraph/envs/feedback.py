"""Feedback along a plan, in NumPy alone.

A robot's loop receives it from a planning process, so its module must not import JAX.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class PlanFeedback:
    r"""A plan's controls with its feedback on deviations from the planned states.

    In step :math:`t`, of which the part :math:`s \in [0, 1)` has passed, with the plan's states
    :math:`\bar x` and controls :math:`\bar u`,

    .. math:: u = \bar u_t + K_t \big( x - (1 - s)\, \bar x_t - s\, \bar x_{t+1} \big).
    """

    states: np.ndarray
    """[H+1, N, 2, D]: planned position m and velocity m/s of each node."""
    controls: np.ndarray
    """[H, U] N"""
    gains: np.ndarray
    """[H, U, N, 2, D]"""
    dt: float
    """s, of a step."""

    @property
    def duration(self) -> float:
        """s, from the plan's observation to its end."""
        return len(self.controls) * self.dt

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[U] N, ``elapsed`` s in [0, duration] after the observation.

        ``position`` and ``velocity``, [n, D] m and m/s of now, may cover the first n nodes only:
        the others are padding.
        """
        step = min(int(elapsed / self.dt), len(self.controls) - 1)
        return self.within(step, elapsed / self.dt - step, position, velocity)

    def within(
        self, step: int, part: float, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """[U] N in a step of the plan after its fraction ``part``."""
        state = np.zeros(self.states.shape[1:])
        state[: len(position), 0], state[: len(position), 1] = position, velocity
        begin, end = self.states[step], self.states[step + 1]
        deviation = state - (begin + part * (end - begin))
        return self.controls[step] + self.gains[step].reshape(-1, state.size) @ deviation.ravel()
