"""A block that nobody sees."""

import numpy as np

from contactgraph_franka.perception.tracker import Estimate

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

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """What an arm has read: the hand at ``hand`` [3] m with ``speed`` [3] m/s.

        ``contact``: 1 where its fingers hold something, 0 where not, NaN where that is not known.
        """
        # Not known is neither touched nor let go.
        if contact > 0.5:
            self._place, self._velocity = hand.copy(), speed.copy()
        elif contact <= 0.5:
            self._velocity = np.zeros(3)

    def estimates(self, now: float) -> list[Estimate]:
        """The one block, at ``now`` s."""
        return [Estimate(self._place, self._velocity, np.full(3, _UNSURE), now, True)]
