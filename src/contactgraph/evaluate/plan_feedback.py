"""A plan as a law: what to do at any time within it, wherever things have got to."""

import numpy as np

from contactgraph.control import Plan


class PlanFeedback:
    r"""The plan's controls, corrected by its feedback about where it meant the nodes to be by then.

    In step :math:`t`, of which the part :math:`s \in [0, 1)` has passed, with the plan's states
    :math:`\bar x` and controls :math:`\bar u`,

    .. math:: u = \bar u_t + K_t \big( x - (1 - s)\, \bar x_t - s\, \bar x_{t+1} \big).

    A `contactgraph.robot.loop.Law`: it owns its numbers, and asking it takes some ten microseconds.
    """

    def __init__(self, plan: Plan, dt: float, capacity: int) -> None:
        """``dt`` s is a step of the plan's model, ``capacity`` the nodes that it was padded to."""
        self._states = np.asarray(plan.states, float)
        self._controls = np.asarray(plan.controls, float)
        self._gains = np.asarray(plan.policy.K, float)
        self._dt = dt
        steps, size = len(self._controls), self._states.shape[-1]
        self._shape = capacity, 2, size // (2 * capacity)
        self.duration = steps * dt
        """s, from the observation that the plan was made from to its end."""

    def __call__(self, elapsed: float, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[U] N, ``elapsed`` s in [0, duration] after the observation; [n, D] m and m/s of now."""
        step = min(int(elapsed / self._dt), len(self._controls) - 1)
        return self.within(step, elapsed / self._dt - step, position, velocity)

    def within(
        self, step: int, part: float, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """[U] N in a step of the plan, of which ``part`` has passed."""
        state = np.zeros(self._shape)
        state[: len(position), 0], state[: len(position), 1] = position, velocity
        begin, end = self._states[step], self._states[step + 1]
        astray = state.ravel() - (begin + part * (end - begin))
        return self._controls[step] + self._gains[step] @ astray
