"""Which blocks the fingers hold, and which blocks touch, by MuJoCo's own contacts."""

import numpy as np

from contactgraph_franka.envs.engine import mujoco


class Touch:
    """The contacts of the finger pads and of ``count`` blocks, whose geoms are ``block0`` and on.

    Plain numbers in loops: it is asked at every tick, and arrays as small as these take longer.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
        self._data = data
        self._count = count
        self._block = {model.geom(f"block{index}").id: index for index in range(count)}
        self._pad = {model.geom("left_pad").id: 0, model.geom("right_pad").id: 1}

    def fingers(self) -> tuple[set[int], list[int]]:
        """The blocks, by index, that any finger touches, and in order those that both touch."""
        touched: tuple[set[int], set[int]] = set(), set()
        for one, other in self._data.contact.geom.tolist():
            if one in self._pad:
                touched[self._pad[one]].add(other)
            elif other in self._pad:
                touched[self._pad[other]].add(one)
        left, right = ({self._block[g] for g in side if g in self._block} for side in touched)
        return left | right, sorted(left & right)

    def between_blocks(self) -> np.ndarray:
        """[M, M] bool, symmetric."""
        contact = np.zeros((self._count, self._count), bool)
        for one, other in self._data.contact.geom.tolist():
            if one in self._block and other in self._block:
                first, second = self._block[one], self._block[other]
                contact[first, second] = contact[second, first] = True
        return contact
