"""What stops the arm where a force would take it farther or faster than it can go."""

import numpy as np

from contactgraph_franka.envs.engine import JOINTS, mujoco

LARGEST_TURN = np.radians(2.0)
"""Of the hand from the orientation it keeps, rad."""
LARGEST_SPEED = 1.5 * np.array([2.175] * 4 + [2.61] * 3)
"""Of the joints, rad/s: half above the maker's, which a fast sweep close to the base just keeps."""
_AHEAD = 0.01
"""For how long a joint must not be on its way out of its range, s."""
_STOP = 0.01
"""By how much it may lean on the end of its range, rad."""
_DAMPING = 500.0
"""Of a joint whose brake is closed, N m s/rad."""


class Brakes:
    """Stop the arm for good once it leaves what it can do, as the maker's controller does.

    That is when a joint is about to leave its range or turns too fast, or the hand loses its
    orientation. Forces get there that push the hand to the end of its reach or slam it onto
    something; a sweep within the scene does not.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model = model
        self._joints, self._velocity = data.qpos[:JOINTS], data.qvel[:JOINTS]
        low, high = model.jnt_range[:JOINTS].T
        self._low, self._high = low - _STOP, high + _STOP
        self.closed = False

    def check(self, turn: np.ndarray) -> None:
        """Closes the brakes where they must be; ``turn`` [3] rad is what the hand is off by."""
        soon = self._joints + _AHEAD * self._velocity
        fits = np.all((self._low < soon) & (soon < self._high))
        slow = np.all(np.abs(self._velocity) < LARGEST_SPEED)
        if not (fits and slow and turn @ turn < LARGEST_TURN**2):
            self.closed = True
            self._model.dof_damping[:JOINTS] = _DAMPING
