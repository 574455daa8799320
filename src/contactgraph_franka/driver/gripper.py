"""The maker's gripper, closed on passing blocks by a thread of its own, with a contact sensor."""

import threading
import time
from collections.abc import Callable

import numpy as np

from contactgraph_franka.driver.client import CLIENT_FAULTS, connect_gripper, first_state, franky
from contactgraph_franka.driver.fingers import LAG, OPEN_WIDTH, FingerContact, GraspTrigger

SPEED = 0.1
"""m/s, of the width: 0.05 m/s for each finger, the maker's largest."""
GRASP_FORCE = 40.0
"""N. The maker grasps continuously with up to 70 N."""
_ANY_WIDTH = 0.08
"""m: tolerance with which an object of any width counts as grasped."""
_LONGEST_COMMAND = 3.0
"""s: opening or closing all the way takes one."""
_INTERVAL = 0.01
"""s between reads of the fingers' state. Reading blocks, without holding Python's lock."""


class FrankaGripper:
    """Fingers controlled in a thread of their own, since their commands block.

    `follow` takes in the blocks' positions and returns at once; the thread then commands the
    fingers. One command ends before the next begins, since the gripper accepts no other. Use as a
    context manager.
    """

    def __init__(
        self, address: str, clock: Callable[[], float] = time.monotonic, lag: float = LAG
    ) -> None:
        """``clock`` gives s; ``lag`` s is the delay of the fingers, to be measured on a real arm.

        Raises `InvalidInputError` where no gripper answers at ``address``.
        """
        self._gripper = connect_gripper(address)
        self._clock = clock
        self._trigger = GraspTrigger(lag)
        self._sensor = FingerContact()
        self._pending: franky.BoolFuture | None = None
        self._closing = False
        self._changed = threading.Event()
        self._ended = threading.Event()
        self.last_error = ""
        """The client's message when the gripper was lost; empty while it is not."""
        first = first_state(self._gripper, address)
        self.width = first.width
        """m, between the fingers."""
        self.largest_width = first.max_width
        """m; zero before the gripper was homed."""
        self.version = self._gripper.server_version
        """Of the gripper's protocol."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> "FrankaGripper":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    @property
    def block(self) -> int:
        """Index of the block that the fingers close on, or closed on last."""
        return self._trigger.block

    def follow(self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray) -> None:
        """Closes or opens the fingers for the blocks' positions: see `GraspTrigger.step`."""
        before = self._trigger.closed
        if self._trigger.step(offset, velocity, tracked, self.width) != before:
            self._changed.set()

    def open(self) -> None:
        """Opens the fingers, whatever they hold, and waits until they are open."""
        self._trigger.release()
        self._changed.set()
        while not self._ended.is_set() and (self._closing or self._pending is not None):
            time.sleep(_INTERVAL)

    def contact(self) -> float:
        """1 where something stops the fingers, 0 where nothing does; NaN where they do not move.

        `FingerContact` states its errors and its delay.
        """
        return self._sensor.value

    def close(self) -> None:
        """Disconnects; the fingers stay as they are."""
        self._ended.set()
        self._changed.set()
        self._thread.join()

    def _run(self) -> None:
        self._pending = self._gripper.move_async(OPEN_WIDTH, SPEED)
        try:
            while not self._ended.is_set():
                self._read()
                self._command()
                if self._changed.wait(_INTERVAL):
                    self._changed.clear()
            # The client's own thread for the last command must not outlive this object.
            if self._pending is not None:
                self._pending.wait(_LONGEST_COMMAND)
        except (*CLIENT_FAULTS, franky.GripperException) as error:
            self.last_error = str(error)
            self._sensor.reset()
            self._ended.set()

    def _read(self) -> None:
        state = self._gripper.state
        self.width, self.largest_width = state.width, state.max_width
        self._sensor.step(state.width, self._clock(), self._closing)

    def _command(self) -> None:
        if self._pending is not None:
            if not self._pending.wait(0.0):
                return
            self._pending = None
        if self._trigger.closed and not self._closing:
            self._closing = True
            self._pending = self._gripper.grasp_async(
                0.0, SPEED, GRASP_FORCE, epsilon_inner=_ANY_WIDTH, epsilon_outer=_ANY_WIDTH
            )
        elif self._closing and not self._trigger.closed:
            self._closing = False
            self._pending = self._gripper.move_async(OPEN_WIDTH, SPEED)
