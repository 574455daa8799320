"""What a person would do between runs, asked of the server: to put a block somewhere."""

import fcntl
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from contactgraph_franka.sim.shared_array import create_shared, open_shared

_ORDER = np.dtype(
    [("asked", "i8"), ("done", "i8"), ("block", "i8"), ("position", "f8", (3,)), ("yaw", "f8")]
)
_PATIENCE = 5.0
"""s, on the wall."""


class OrderTaker:
    """The server's end."""

    def __init__(self, folder: Path) -> None:
        self._order = create_shared(folder / "orders", _ORDER, 1)
        self._done = 0

    def carry_out(self, place: Callable[[int, np.ndarray, float], None]) -> None:
        """Calls ``place(block, position, yaw)`` where something was asked since the last call."""
        asked = int(self._order["asked"][0])
        if asked != self._done:
            order = self._order[0]
            place(int(order["block"]), order["position"].copy(), float(order["yaw"]))
            self._done = asked
            self._order["done"] = asked


def order_block(folder: Path, block: int, position: np.ndarray, yaw: float) -> None:
    """Has ``block`` put at ``position`` [3] m, turned by ``yaw`` rad, and waits until it is.

    Raises `RuntimeError` where the server does not do so.
    """
    order = open_shared(folder / "orders", _ORDER, write=True)
    with (folder / "orders.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        asked = int(order["asked"][0]) + 1
        order["block"], order["position"], order["yaw"] = block, position, yaw
        order["asked"] = asked
        until = time.monotonic() + _PATIENCE
        while int(order["done"][0]) != asked:
            if time.monotonic() > until:
                raise RuntimeError("the rehearsal's server did not put the block there in 5 s")
            time.sleep(0.001)
