"""Why a robot was stopped, in words."""

from dataclasses import dataclass
from enum import Enum


class StopReason(Enum):
    """What stopped the robot. The value is the sentence that a user reads."""

    FINISHED = "the run is over"
    ASKED = "somebody asked for it"
    PLANNER_FAILED = "the planner broke down"
    COMMAND_UNUSABLE = "the controller's command is not a force of finite numbers"
    COMMAND_LATE = "no new command came from the controller in time"
    LOOP_LATE = "the control loop itself came too late"
    CLOCK_BROKEN = "the clock ran backwards or gave no number"
    ARM_STOPPED = "the arm stopped by itself: a reflex, a joint's limit, or its stop button"
    CONNECTION_LOST = "the robot sends no readings, or commands do not reach it"
    READING_NOT_FINITE = "a reading is not made of finite numbers"
    READING_UNFIT = "a reading has other nodes or dimensions than it should"
    READING_STALE = "what was read is too old"
    READING_FROZEN = "the robot's clock stands still"
    POSITION_JUMPED = "a position moved farther than a body can"
    OBJECT_LOST = "an object is no longer tracked"
    OUTSIDE_WORKSPACE = "the hand is outside its workspace"
    TOO_FAST = "the hand is faster than it may be"

    @property
    def wanted(self) -> bool:
        """Whether the robot stopped because it should, and not because something was wrong."""
        return self in (StopReason.FINISHED, StopReason.ASKED)


@dataclass(frozen=True)
class Stop:
    """That a robot was stopped."""

    reason: StopReason
    time: float
    """s, on the clock of whoever stopped it."""

    def __str__(self) -> str:
        return f"stopped at {self.time:.3f} s: {self.reason.value}"
