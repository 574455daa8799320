"""Readings of an arm, assembled from its hand, its object source and its fingers."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from contactgraph_franka.perception.tracked_objects import TrackedObjects
from contactgraph_franka.perception.tracker import Estimate
from contactgraph_franka.safety.robot import RobotReading

if TYPE_CHECKING:
    from contactgraph_franka.driver.gripper import FrankaGripper

_HAND_VARIANCE = 1e-8
"""m^2: the maker states a repeatability of 0.1 mm."""
_BLOCK_VARIANCE = 1e-6
"""m^2, of a position given by a person: to a millimetre."""


class ReadingBuilder:
    """Assembles readings. Node 0 is the hand, the others are the objects."""

    def __init__(self, objects: "ObjectSource | None", fingers: "FrankaGripper | None") -> None:
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
    """An object source without a camera: a block at a given position until the fingers hold it.

    From then on it moves with the hand.
    """

    tracks = None
    """No frames to smooth; see `TrackedObjects`."""

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
        """See `TrackedObjects`."""
        # An unknown contact changes nothing.
        if contact > 0.5:
            self._position, self._velocity = hand.copy(), speed.copy()
        elif contact <= 0.5:
            self._velocity = np.zeros(3)

    def estimates(self, now: float) -> list[Estimate]:
        """The one block, at ``now`` s."""
        return [Estimate(self._position, self._velocity, np.full(3, _BLOCK_VARIANCE), now, True)]


ObjectSource: TypeAlias = TrackedObjects | AssumedBlock
"""A source of object positions."""
