"""A block that nobody sees."""

import numpy as np

from contactgraph.robot.contract import RobotReading
from contactgraph.robot.perception.tracker import Estimate

_UNSURE = 1e-6
"""m^2: where a person says that a block is, to a millimetre."""


class AssumedBlock:
    """Stands where somebody said, until the fingers hold it; from then on it is in the hand.

    For arms without a camera: whether the block was really there, only the fingers tell.
    """

    def __init__(self, place: np.ndarray) -> None:
        """``place`` [3] m: its centre."""
        self._said = np.array(place, dtype=np.float64)
        self.begin()

    def begin(self) -> None:
        """It stands where it was said to stand."""
        self._place, self._velocity = self._said.copy(), np.zeros(3)

    def note(self, reading: RobotReading | None) -> None:
        """What the arm has read: the hand, and what its fingers touch."""
        if reading is None or reading.contact is None:
            return
        # Not measured is neither touched nor let go.
        if reading.contact[0, 1] > 0.5:
            self._place, self._velocity = reading.position[0].copy(), reading.velocity[0].copy()
        elif reading.contact[0, 1] <= 0.5:
            self._velocity = np.zeros(3)

    def estimates(self, now: float) -> list[Estimate]:
        """The one block, at ``now`` s."""
        return [Estimate(self._place, self._velocity, np.full(3, _UNSURE), now, True)]
