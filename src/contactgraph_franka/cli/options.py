"""What a user says about an arm, whatever it is to do."""

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from contactgraph.cli import CommandError

if TYPE_CHECKING:
    import numpy as np

    from contactgraph_franka.safety import SafetyLimits

LONGEST_GAP = 0.006
"""s: a loop in Python has hiccups of three to six milliseconds."""
_FAKE_GAP, _FAKE_STOP = 0.05, 0.1
"""s: nobody gets hurt by the fake arm, so that it may run beside whatever else a computer does."""
FAKE = "fake"
"""The address of the arm for whoever has none."""
LONGEST_TRACK_AGE = 0.2
"""s: what a tracker calls lost."""
LARGEST_JUMP = 0.05
"""m: a tracker that sees a block struck corrects itself by centimetres from one frame to the next;
so it is with one that sees a single tag of a held block, and takes its leaning for another."""


@dataclass(frozen=True)
class ArmOptions:
    """How an arm sees, and how hard it may push."""

    camera: str = "none"
    """Who sees the block: none (it stands at --block), realsense, or rendered (in a rehearsal)."""
    calibration: Annotated[Path | None, arg(metavar="FILE")] = None
    """Where the camera stands, as calibrate writes it; a rehearsal's own if not given."""
    block: Annotated[tuple[float, ...] | None, arg(metavar="X Y Z")] = None
    """The centre of the block, m, where no camera sees it."""
    max_force: Annotated[float, arg(metavar="N")] = 16.0
    """The longest force on the hand, N. Begin with 5."""

    def limits(self, address: str) -> "SafetyLimits":
        """What the arm at ``address`` must keep to.

        Raises `InvalidInputError` for a force that is too large.
        """
        from contactgraph.data import InvalidInputError
        from contactgraph_franka.safety import SafetyLimits

        usual = SafetyLimits()
        most = usual.max_force_rate * (usual.stop_within - LONGEST_GAP)
        if not 0.0 < self.max_force <= most:
            raise InvalidInputError(
                f"--max-force must be above 0 and at most {most:g} N, found {self.max_force:g}: "
                f"a larger force cannot be eased off within {1e3 * usual.stop_within:g} ms"
            )
        gap = _FAKE_GAP if address == FAKE else LONGEST_GAP
        return SafetyLimits(
            max_force=self.max_force,
            longest_age=gap,
            longest_track_age=LONGEST_TRACK_AGE,
            longest_gap=gap,
            largest_jump=LARGEST_JUMP,
            stop_within=_FAKE_STOP if address == FAKE else usual.stop_within,
        )


def place(flag: str, numbers: Sequence[float], limits: "SafetyLimits") -> "np.ndarray":
    """[3] m. Raises `InvalidInputError` for what is no place within the workspace."""
    import numpy as np

    from contactgraph.data import InvalidInputError

    low, high = limits.workspace_low, limits.workspace_high
    ranges = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
    found = " ".join(f"{number:g}" for number in numbers)
    inside = len(numbers) == len(low) and all(
        math.isfinite(x) and a <= x <= b for x, a, b in zip(numbers, low, high, strict=True)
    )
    if not inside:
        raise InvalidInputError(
            f"{flag} must be a place in the arm's workspace, {ranges} m, found {found or 'none'}"
        )
    return np.array(numbers, dtype=float)


def check_seconds(flag: str, seconds: float, most: float = 600.0) -> None:
    """Raises `InvalidInputError` for what no run lasts."""
    from contactgraph.data import InvalidInputError

    if not 0.0 < seconds <= most:
        raise InvalidInputError(f"{flag} must be above 0 and at most {most:g} s, found {seconds:g}")


class RobotFault(CommandError):
    """A fault of the robot; the message is one line for the user."""


if TYPE_CHECKING:
    from contactgraph_franka.cli.arms import Arm

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
    print(f"{arm.words}: {what}")
    if not arm.real:
        return
    print("Keep a hand on its stop button, and nobody in its reach. Ctrl-C stops it gently.")
    for left in range(_COUNT, 0, -1):
        print(f"in {left} s ...")
        time.sleep(1.0)


def wait_for_block(arm: "Arm") -> None:
    """Returns when the block is steadily seen; raises `RobotFault` where it is not."""
    from contactgraph_franka.cli.options import RobotFault

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
