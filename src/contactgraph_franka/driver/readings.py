"""Readings of an arm, assembled from its hand, its object source and its fingers."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from contactgraph_franka.perception.tracker import Estimate
from contactgraph_franka.safety.robot import RobotReading

_HAND_VARIANCE = 1e-8
"""m^2: the maker states a repeatability of 0.1 mm."""
_BLOCK_VARIANCE = 1e-6
"""m^2, of a position given by a person: to a millimetre."""


class ObjectSource(Protocol):
    """A source of object positions: see `contactgraph_franka.perception`."""

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """Takes in the hand's position [3] m and velocity [3] m/s at ``stamp`` s.

        ``contact``: 1 where its fingers hold ``block``, 0 where not, NaN where that is unknown.
        """

    def estimates(self, now: float) -> Sequence[Estimate]:
        """One for each object, at ``now`` s."""


class Fingers(Protocol):
    """The fingers of the hand: see `FrankaGripper`."""

    @property
    def block(self) -> int:
        """Index of the block that they close on, or closed on last."""

    def follow(self, offset: np.ndarray, velocity: np.ndarray, tracked: np.ndarray) -> None:
        """Closes or opens them: ``offset`` [M, 3] m to the blocks, ``velocity`` [M, 3] m/s of the
        grasp point relative to them, ``tracked`` [M] bool."""

    def contact(self) -> float:
        """1 where they hold the block, 0 where not, NaN where that is unknown."""


class ReadingBuilder:
    """Assembles readings. Node 0 is the hand, the others are the objects."""

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
        """The hand at ``hand`` [3] m with ``speed`` [3] m/s at ``stamp`` s, and objects at ``now``.

        ``acting``: whether the fingers may move.
        """
        objects: Sequence[Estimate] = ()
        fingers, touch = self._fingers, math.nan
        if self._objects is not None:
            if fingers is not None:
                touch = fingers.contact()
                self._objects.follow(hand, speed, stamp, fingers.block, touch)
            objects = self._objects.estimates(now)
        position = np.array([hand, *[one.position for one in objects]])
        velocity = np.array([speed, *[one.velocity for one in objects]])
        tracked = np.array([True, *[one.tracked for one in objects]])
        contact = None
        if fingers is not None and objects:
            contact = np.full((len(position),) * 2, np.nan)
            np.fill_diagonal(contact, 0.0)
            block = 1 + fingers.block
            contact[0, block] = contact[block, 0] = touch
            if acting:
                fingers.follow(position[1:] - hand, speed - velocity[1:], tracked[1:])
        return RobotReading(
            position=position,
            velocity=velocity,
            time=np.array([stamp, *[one.time for one in objects]]),
            robot_time=robot_time,
            tracked=tracked,
            variance=np.array([(_HAND_VARIANCE,) * 3, *[one.variance for one in objects]]),
            contact=contact,
        )


class AssumedBlock:
    """An `ObjectSource` without a camera: a block at a given position until the fingers hold it.

    From then on it moves with the hand.
    """

    def __init__(self, position: np.ndarray) -> None:
        """``position`` [3] m of its centre."""
        self._given = np.array(position, dtype=np.float64)
        self.begin()

    def begin(self) -> None:
        """Puts the block back to the given position."""
        self._position, self._velocity = self._given.copy(), np.zeros(3)

    def follow(
        self, hand: np.ndarray, speed: np.ndarray, stamp: float, block: int, contact: float
    ) -> None:
        """See `ObjectSource`."""
        # An unknown contact changes nothing.
        if contact > 0.5:
            self._position, self._velocity = hand.copy(), speed.copy()
        elif contact <= 0.5:
            self._velocity = np.zeros(3)

    def estimates(self, now: float) -> list[Estimate]:
        """The one block, at ``now`` s."""
        return [Estimate(self._position, self._velocity, np.full(3, _BLOCK_VARIANCE), now, True)]
