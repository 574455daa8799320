"""The robot interface: readings, commands and stops. ``N`` nodes in ``D`` dimensions."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from contactgraph.data import InvalidInputError


class StopReason(Enum):
    """Causes of a stop. The value is the sentence shown to the user."""

    FINISHED = "the episode is over"
    ASKED = "a stop was requested"
    PLANNER_FAILED = "the planner failed"
    COMMAND_UNUSABLE = "the controller's command is not a force of finite numbers"
    COMMAND_LATE = "no new command came from the controller in time"
    LOOP_LATE = "the control loop itself came too late"
    CLOCK_BROKEN = "the clock ran backwards or gave no number"
    ARM_STOPPED = "the arm stopped by itself: a reflex, a joint's limit, or its stop button"
    CONNECTION_LOST = "the robot sends no readings, or commands do not reach it"
    READING_NOT_FINITE = "a reading is not made of finite numbers"
    READING_UNFIT = "a reading has other nodes or dimensions than it should"
    READING_STALE = "a reading is too old"
    READING_FROZEN = "the robot's clock stands still"
    POSITION_JUMPED = "a position moved farther than a body can"
    OBJECT_LOST = "an object is no longer tracked"
    OUTSIDE_WORKSPACE = "the hand is outside its workspace"
    TOO_FAST = "the hand is faster than it may be"

    @property
    def wanted(self) -> bool:
        """Whether the stop was intended, and not caused by a fault."""
        return self in (StopReason.FINISHED, StopReason.ASKED)


@dataclass(frozen=True)
class Stop:
    """A stop of the robot: its reason and time."""

    reason: StopReason
    time: float
    """s, on the clock of the part that stopped the robot."""

    def __str__(self) -> str:
        return f"stopped at {self.time:.3f} s: {self.reason.value}"


@dataclass(frozen=True, eq=False)
class RobotReading:
    """Positions and velocities of all nodes, with time stamps and uncertainty.

    Shapes are checked on construction. Values are not: a bad value is a fault of the robot, which
    `SafetyFilter` handles. Raises `InvalidInputError` where shapes do not fit.
    """

    position: np.ndarray
    """[N, D] m, in the frame of the robot's base."""
    velocity: np.ndarray
    """[N, D] m/s."""
    time: np.ndarray
    """[N] s, on the reader's clock: when each node was at ``position``, not when it was reported.
    The hand is measured a millisecond ago, a camera's object some thirty."""
    robot_time: float
    """s, on the robot's own clock, which advances while the robot is alive."""
    tracked: np.ndarray
    """[N] bool: whether the node's sensor still tracks it."""
    variance: np.ndarray | None = None
    """[N, D] m^2, of ``position``; None where it is unknown."""
    contact: np.ndarray | None = None
    """[N, N] contact probability, 0 to 1, symmetric, zero diagonal; NaN where it was not measured.
    None without a contact sensor."""

    def __post_init__(self) -> None:
        for name, kind in (("position", float), ("velocity", float), ("time", float)):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        object.__setattr__(self, "tracked", np.asarray(self.tracked, dtype=bool))
        if self.position.ndim != 2:
            raise InvalidInputError(f"position must be [N, D], found {self.position.shape}")
        count, dimension = self.position.shape
        shapes = {
            "velocity": (count, dimension),
            "time": (count,),
            "tracked": (count,),
            "variance": (count, dimension),
            "contact": (count, count),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise InvalidInputError(f"{name} must be {list(shape)}, found {np.shape(value)}")

    def observation(self, goal: np.ndarray) -> dict[str, np.ndarray]:
        """A task's observation, for policies: position, velocity, contact, and ``goal`` [D] m.

        ``contact`` [N, N] is NaN where it was not measured, since 0 would state "no contact".
        """
        count = len(self.position)
        contact = np.full((count, count), np.nan) if self.contact is None else self.contact
        return {
            "position": self.position,
            "velocity": self.velocity,
            "contact": np.asarray(contact, dtype=np.float64),
            "goal": np.asarray(goal, dtype=np.float64),
        }


@dataclass(frozen=True, eq=False)
class Command:
    """A force requested by a controller, not yet checked by `SafetyFilter`."""

    force: np.ndarray
    """[D] N, on the hand, in the frame of the robot's base."""
    time: float
    """s, on the reader's clock: when it was decided. A late plan is an old command."""


class Robot(Protocol):
    """A real or simulated arm. No method blocks for longer than a control cycle of the robot.

    A robot that receives no command for a few cycles must ease its force off by itself, as arms
    with a real-time interface do: no other part can stop it then.
    """

    @property
    def ended(self) -> Stop | None:
        """Why and when the robot stopped by itself (a reflex, a button); None while it did not."""

    def read(self) -> RobotReading | None:
        """The newest reading; None where none has come since the last call."""

    def send(self, force: np.ndarray, now: float) -> np.ndarray | None:
        """Requests a force ``[D]`` N on the hand at the time ``now`` s.

        Returns the force really sent, ``[D]`` N, or None where it got lost.
        """

    def stop(self, stop: Stop) -> None:
        """Brakes and holds by the robot's own means. Forces are ignored until `resume`.

        Called again in every cycle, since a call may get lost on its way.
        """

    def resume(self) -> None:
        """Ends `stop`: forces count again."""
