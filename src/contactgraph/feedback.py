"""The feedback law of all policies and plans, for arrays of NumPy and of JAX.

A robot's loop receives a `PlanFeedback` from a planning process, so this module must not import
JAX.
"""

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


def feedback_control(
    nominal: Any, gains: Any, deviation: Any, product: Callable[[Any, Any], Any] = operator.matmul
) -> Any:
    r"""The control $u = \bar u + K (x - \bar x)$, N, of arrays of any library.

    ``nominal`` is $\bar u$ [U] N, ``gains`` is K [U, n] N/m and N s/m, and ``deviation`` is
    $x - \bar x$ [n] m and m/s; or what ``product`` multiplies, such as one of each a step.
    """
    return nominal + product(gains, deviation)


@dataclass(frozen=True, eq=False)
class PlanFeedback:
    r"""A plan's controls with its feedback on deviations from the planned states.

    In step $t$, of which the part $s \in [0, 1)$ has passed, with the plan's states
    $\bar x$ and controls $\bar u$,

    $$ u = \bar u_t + K_t \big( x - (1 - s)\, \bar x_t - s\, \bar x_{t+1} \big). $$
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
        gains = self.gains[step].reshape(-1, deviation.size)
        return feedback_control(self.controls[step], gains, deviation.ravel())
