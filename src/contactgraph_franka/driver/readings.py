"""What a reading of an arm is made of: the hand, what is seen, and what the fingers tell."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from contactgraph_franka.perception.tracker import Estimate
from contactgraph_franka.safety.robot import RobotReading

_HAND_VARIANCE = 1e-8
"""m^2: the maker states a repeatability of 0.1 mm."""


class ObjectSource(Protocol):
    """Whoever measures objects: see `contactgraph_franka.perception`."""

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """Is told the hand's place [3] m and speed [3] m/s at ``stamp`` s, and whether its fingers
        hold ``block``: 1, 0, or NaN where that is not known."""

    def estimates(self, now: float) -> Sequence[Estimate]:
        """One for each object, at ``now`` s."""


class Fingers(Protocol):
    """What opens and closes at the hand: see `FrankaGripper`."""

    @property
    def block(self) -> int:
        """The block that they close on, or closed on last."""

    def follow(self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray) -> None:
        """Closes or opens them: ``offset`` [M, 3] m to the blocks, ``velocity`` [M, 3] m/s of the
        grasp point against them, ``tracked`` [M] bool."""

    def contact(self) -> float:
        """1, 0, or NaN where it cannot be told: whether they hold the block."""


class ReadingBuilder:
    """Puts readings together. Node 0 is the hand."""

    def __init__(self, objects: ObjectSource | None, fingers: Fingers | None) -> None:
        self._objects, self._fingers = objects, fingers

    def reading(
        self,
        hand: np.ndarray,
        speed: np.ndarray,
        stamp: float,
        robot_time: float,
        now: float,
        acting: bool,
    ) -> RobotReading:
        """The hand at ``hand`` [3] m with ``speed`` [3] m/s at ``stamp`` s, and what is seen now.

        ``acting``: whether the fingers may move.
        """
        seen: Sequence[Estimate] = ()
        fingers, touch = self._fingers, math.nan
        if self._objects is not None:
            if fingers is not None:
                touch = fingers.contact()
                self._objects.follow(hand, speed, stamp, fingers.block, touch)
            seen = self._objects.estimates(now)
        position = np.array([hand, *[one.position for one in seen]])
        velocity = np.array([speed, *[one.velocity for one in seen]])
        tracked = np.array([True, *[one.tracked for one in seen]])
        contact = None
        if fingers is not None and seen:
            contact = np.full((len(position),) * 2, np.nan)
            np.fill_diagonal(contact, 0.0)
            block = 1 + fingers.block
            contact[0, block] = contact[block, 0] = touch
            if acting:
                fingers.follow(position[1:] - hand, speed - velocity[1:], tracked[1:])
        return RobotReading(
            position=position,
            velocity=velocity,
            time=np.array([stamp, *[one.time for one in seen]]),
            robot_time=robot_time,
            tracked=tracked,
            variance=np.array([(_HAND_VARIANCE,) * 3, *[one.variance for one in seen]]),
            contact=contact,
        )


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
