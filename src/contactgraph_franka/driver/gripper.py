"""The maker's gripper: fingers that close by themselves in time, and tell what stopped them."""

import threading
import time
from collections.abc import Callable
from types import TracebackType

import numpy as np

from contactgraph_franka.driver.client import CLIENT_FAULTS, connect_gripper, first_state, franky
from contactgraph_franka.driver.fingers import LAG, OPEN_WIDTH, FingerContact, GraspTrigger

SPEED = 0.1
"""m/s, of the width: 0.05 m/s for each finger, the maker's largest."""
GRASP_FORCE = 40.0
"""N. The maker grasps continuously with up to 70 N."""
_ANY_WIDTH = 0.08
"""m: whatever the fingers meet is what they were to hold."""
_LONGEST_COMMAND = 3.0
"""s: the fingers need one for their whole way."""
_LOOK = 0.01
"""s between looks at the fingers. Each waits for one of their states, without holding Python up."""


class FrankaGripper:
    """Fingers with a will of their own, in a thread of their own, since their commands block.

    `follow` is told where blocks are and answers at once; the fingers are sent after it. One
    command ends before the next begins: an arm's gripper takes no other. Use as a context manager.
    """

    def __init__(
        self, address: str, clock: Callable[[], float] = time.monotonic, lag: float = LAG
    ) -> None:
        """``clock`` gives s; ``lag`` s is how late the fingers begin to move, an arm's own to be
        measured. Raises `InvalidInputError` where no gripper answers at ``address``."""
        self._gripper = connect_gripper(address)
        self._clock = clock
        self._reflex = GraspTrigger(lag)
        self._sensor = FingerContact()
        self._pending: franky.BoolFuture | None = None
        self._closing = False
        self._news = threading.Event()
        self._ended = threading.Event()
        self.last_error = ""
        """What the client said when the gripper was lost; empty while it is not."""
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def block(self) -> int:
        """The block that the fingers close on, or closed on last."""
        return self._reflex.block

    def follow(self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray) -> None:
        """Closes or opens the fingers by where the blocks are: see `GraspTrigger.step`."""
        before = self._reflex.closed
        if self._reflex.step(offset, velocity, tracked, self.width) != before:
            self._news.set()

    def open(self) -> None:
        """Opens the fingers, whatever they hold, and waits until they are."""
        self._reflex.release()
        self._news.set()
        while not self._ended.is_set() and (self._closing or self._pending is not None):
            time.sleep(_LOOK)

    def contact(self) -> float:
        """1 where something stops the fingers, 0 where nothing does; NaN where they do not move.

        `FingerContact` says how often that is wrong, and how late it is.
        """
        return self._sensor.value

    def close(self) -> None:
        """Leaves the fingers as they are, and lets go of the gripper."""
        self._ended.set()
        self._news.set()
        self._thread.join()

    def _run(self) -> None:
        self._pending = self._gripper.move_async(OPEN_WIDTH, SPEED)
        try:
            while not self._ended.is_set():
                self._look()
                self._obey()
                if self._news.wait(_LOOK):
                    self._news.clear()
            # The client's own thread for the last command must not outlive this object.
            if self._pending is not None:
                self._pending.wait(_LONGEST_COMMAND)
        except (*CLIENT_FAULTS, franky.GripperException) as error:
            self.last_error = str(error)
            self._sensor.reset()
            self._ended.set()

    def _look(self) -> None:
        told = self._gripper.state
        self.width, self.largest_width = told.width, told.max_width
        self._sensor.step(told.width, self._clock(), self._closing)

    def _obey(self) -> None:
        if self._pending is not None:
            if not self._pending.wait(0.0):
                return
            self._pending = None
        if self._reflex.closed and not self._closing:
            self._closing = True
            self._pending = self._gripper.grasp_async(
                0.0, SPEED, GRASP_FORCE, epsilon_inner=_ANY_WIDTH, epsilon_outer=_ANY_WIDTH
            )
        elif self._closing and not self._reflex.closed:
            self._closing = False
            self._pending = self._gripper.move_async(OPEN_WIDTH, SPEED)
