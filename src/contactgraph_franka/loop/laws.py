"""Laws that planners answer with.

They come from another process into the midst of a loop, so what they are made of must be imported
there already, and light: numbers, and nothing that planning needs.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class FeedbackLaw:
    r"""A plan's controls, corrected by its feedback about where it meant the nodes to be by then.

    In step :math:`t`, of which the part :math:`s \in [0, 1)` has passed, with the plan's states
    :math:`\bar x` and controls :math:`\bar u`,

    .. math:: u = \bar u_t + K_t \big( x - (1 - s)\, \bar x_t - s\, \bar x_{t+1} \big).
    """

    states: np.ndarray
    """[H+1, N, 2, D]: position m and velocity m/s of each node, as planned."""
    controls: np.ndarray
    """[H, U] N"""
    gains: np.ndarray
    """[H, U, 2ND]"""
    dt: float
    """s, of a step."""

    @property
    def duration(self) -> float:
        """s, from the observation that the plan was made from to its end."""
        return len(self.controls) * self.dt

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[U] N, ``elapsed`` s in [0, duration] after the observation.

        ``position`` and ``velocity``, [n, D] m and m/s of now, may be of the first n nodes only:
        the others are padding.
        """
        step = min(int(elapsed / self.dt), len(self.controls) - 1)
        return self.within(step, elapsed / self.dt - step, position, velocity)

    def within(
        self, step: int, part: float, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """[U] N in a step of the plan, of which ``part`` has passed."""
        state = np.zeros(self.states.shape[1:])
        state[: len(position), 0], state[: len(position), 1] = position, velocity
        begin, end = self.states[step], self.states[step + 1]
        astray = state - (begin + part * (end - begin))
        return self.controls[step] + self.gains[step] @ astray.ravel()
