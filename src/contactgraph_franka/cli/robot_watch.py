"""What stands between a person and an arm: words before it moves, and Ctrl-C while it does."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from contactgraph.cli.output import say

if TYPE_CHECKING:
    from contactgraph_franka.cli.robot_arms import Arm

_COUNT = 3
"""s, in which a person can still say no."""
_SIGHT_S = 5.0
"""s in which a camera should have seen the block."""
_STEADY_S = 0.5
"""s for which it must be seen without a break: longer than a tracker believes what is no more."""


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """Within, Ctrl-C interrupts nothing: the function tells whether it was pressed.

    A second one does interrupt, for whoever cannot wait: the arm brakes by itself then.
    """
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        if len(pressed) > 1:
            raise KeyboardInterrupt

    usual = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, usual)


def count_down(arm: "Arm", what: str) -> None:
    """Says what will happen, and leaves a real arm's person time to prevent it."""
    say(f"{arm.words}: {what}")
    if not arm.real:
        return
    say("Keep a hand on its stop button, and nobody in its reach. Ctrl-C stops it gently.")
    for left in range(_COUNT, 0, -1):
        say(f"in {left} s ...")
        time.sleep(1.0)


def wait_for_block(arm: "Arm") -> None:
    """Returns when the block is steadily seen; raises `RobotFault` where it is not."""
    from contactgraph_franka.cli.robot_fault import RobotFault

    since = began = arm.clock()
    while arm.seen is not None:
        now = arm.clock()
        if not all(each.tracked for each in arm.seen.estimates(now)):
            since = now
        if now - since > _STEADY_S:
            return
        if now - began > _SIGHT_S:
            raise RobotFault(
                "the camera does not see the block: is it in the picture, lit, its tags towards "
                "the camera, and the calibration this camera's?"
            )
        time.sleep(0.02)
