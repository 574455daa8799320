"""Options, checks and prompts that the commands of the arm share."""

import math
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

import numpy as np
from tyro.conf import arg

from contactgraph.cli import CommandError
from contactgraph.data import InvalidInputError
from contactgraph_franka.safety import SafetyLimits

FAKE = "fake"
"""Address of the fake arm."""
_LONGEST_GAP = 0.006
"""s: a loop in Python has pauses of three to six milliseconds."""
_FAKE_GAP, _FAKE_STOP = 0.05, 0.1
"""s: longer for the fake arm, which is harmless and may run on a busy computer."""
_LONGEST_TRACK_AGE = 0.2
"""s: the tracker's own limit."""
_LARGEST_JUMP = 0.05
"""m: a tracker corrects the position of a struck block by centimetres from one frame to the next,
and that of a grasped block with a single visible tag, whose tilt is ambiguous."""
NO_BLOCK = (
    "is it in the picture, lit, its tags towards the camera, and the calibration this camera's?"
)


class RobotFault(CommandError):
    """A fault of the robot; the message is one line for the user."""


@dataclass(frozen=True)
class ArmOptions:
    """Sensors of an arm, and its largest force."""

    camera: str = "none"
    """Camera that tracks the block: none (it stands at --block), realsense, or rendered (simulated
    robot only)."""
    calibration: Annotated[Path | None, arg(metavar="FILE")] = None
    """Calibration of the camera, as written by calibrate; a simulated robot has its own."""
    block: Annotated[tuple[float, ...] | None, arg(metavar="X Y Z")] = None
    """The centre of the block, m, without a camera."""
    max_force: Annotated[float, arg(metavar="N")] = 16.0
    """The largest force on the hand, N. Begin with 5."""

    def limits(self, address: str) -> SafetyLimits:
        """The safety limits for the arm at ``address``.

        Raises `InvalidInputError` for a force that is too large.
        """
        default = SafetyLimits()
        most = default.max_force_rate * (default.stop_within - _LONGEST_GAP)
        if not 0.0 < self.max_force <= most:
            raise InvalidInputError(
                f"--max-force must be above 0 and at most {most:g} N, found {self.max_force:g}: "
                f"a larger force cannot be eased off within {1e3 * default.stop_within:g} ms"
            )
        gap = _FAKE_GAP if address == FAKE else _LONGEST_GAP
        return SafetyLimits(
            max_force=self.max_force,
            longest_age=gap,
            longest_track_age=_LONGEST_TRACK_AGE,
            longest_gap=gap,
            largest_jump=_LARGEST_JUMP,
            stop_within=_FAKE_STOP if address == FAKE else default.stop_within,
        )


def check_position(flag: str, numbers: Sequence[float], limits: SafetyLimits) -> np.ndarray:
    """[3] m. Raises `InvalidInputError` for a position outside the workspace."""
    low, high = limits.workspace_low, limits.workspace_high
    ranges = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
    found = " ".join(f"{number:g}" for number in numbers)
    inside = len(numbers) == len(low) and all(
        math.isfinite(x) and a <= x <= b for x, a, b in zip(numbers, low, high, strict=True)
    )
    if not inside:
        raise InvalidInputError(
            f"{flag} must be a position in the arm's workspace, {ranges} m, found {found or 'none'}"
        )
    return np.array(numbers, dtype=float)


def check_seconds(flag: str, seconds: float, most: float = 600.0) -> None:
    """Raises `InvalidInputError` for an invalid duration of an episode."""
    if not 0.0 < seconds <= most:
        raise InvalidInputError(f"{flag} must be above 0 and at most {most:g} s, found {seconds:g}")


def point(position: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """A position as text, such as ``(0.50, 0.20, 0.30)``."""
    return "(" + ", ".join(f"{number:.{digits}f}" for number in position) + ")"


@contextmanager
def ctrl_c() -> Iterator[Callable[[], bool]]:
    """Within, the first Ctrl-C does not interrupt; the function returns whether it was pressed.

    A second one interrupts at once, and the arm brakes by itself.
    """
    pressed: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        if len(pressed) > 1:
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, previous)
